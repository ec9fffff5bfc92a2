"""A bound on sizes: Gaussians are not much larger than they are far from cameras beside them.

A splat is drawn as if its Gaussian were small for its distance. One that is not spreads over what a
camera sees that has it at its side, or behind it, whether or not a training photo shows that
(docs/floaters.md). Cameras that have it in their photo say themselves how large it is. The rule is
ours.
"""

from math import log
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_core.contract.scene import Scene, is_in_image
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState

#: Sizes are looked at once in so many steps.
EVERY: Final = 50
#: Scene extents. Smaller Gaussians stay, which most are, and hardly one of them is above the bound.
LEAST: Final = 0.01
#: Distances that are worked out at once.
_AT_ONCE: Final = 2**20


def clamp_scales(setup: Setup, state: TrainState) -> None:
    """Shortens axes that are too long, in place, in the steps in which sizes are looked at."""
    if state.step % EVERY:
        return
    names, bound = setup.backbone.gaussian_tensors, setup.numbers.max_scale_ratio
    if names is None or not bound:
        return
    positions, scales, _ = (state.tensors[each].detach() for each in names)
    largest = scales.amax(dim=1)
    rows = (largest > log(LEAST)).nonzero().squeeze(1)
    rows = rows[_may_be_near(setup.scene, positions[rows], torch.exp(largest[rows]) / bound)]
    distances = _nearest_beside(setup.scene, positions[rows].double().cpu().numpy())
    most = torch.from_numpy(np.log(np.maximum(bound * distances, LEAST))).to(scales)
    # What has diverged is for the checks to find.
    above = (largest[rows] > most) & largest[rows].isfinite()
    rows, most = rows[above], most[above]
    scales[rows] = torch.minimum(scales[rows], most[:, None])


def _may_be_near(scene: Scene, positions: Tensor, distances: Tensor) -> Tensor:
    """[N] bool: all positions [N, 3] that are nearer to any training camera, and few others.

    Products tell that fastest. They lose what is small of two large positions, so that as much is
    taken off.
    """
    centers = torch.from_numpy(scene.centers).to(positions)
    squares, of_centers = (each.square().sum(dim=1) for each in (positions, centers))
    nearest = [
        torch.addmm(of_centers, some, centers.T, alpha=-2.0).amin(dim=1)
        for some in torch.split(positions, max(1, _AT_ONCE // len(centers)))
    ]
    lost = 16.0 * torch.finfo(positions.dtype).eps * (squares + of_centers.amax())
    return distances.square() > squares + torch.cat(nearest) - lost


def _nearest_beside(scene: Scene, positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """[N] distance to the nearest training camera that has a position [N, 3] not in its photo.

    Infinite for what all photos show.
    """
    nearest = np.full(len(positions), np.inf)
    for view in scene.train_views:
        apart = np.linalg.norm(positions - view.camera.center.numpy(), axis=1)
        apart[is_in_image(view.camera, positions)] = np.inf
        nearest = np.minimum(nearest, apart)
    return nearest

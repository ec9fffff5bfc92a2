"""A bound on sizes: Gaussians are not much larger than they are far from cameras beside them.

A splat is drawn as if its Gaussian were small for its distance. One that is not spreads over what a
camera sees that has it at its side, or behind it, whether or not a training photo shows that
(docs/floaters.md). Cameras that have it in their photo say themselves how large it is. The rule is
ours.
"""

from collections.abc import Iterator
from math import log
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_core.contract.poses import is_in_image
from crossgrad_core.contract.scene import Scene
from crossgrad_core.training.rates import gaussians_of, is_short
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState

#: Largest standard deviation, of the distance to the nearest camera that has it at its side.
BOUND: Final = 0.5
#: Sizes are looked at once in so many steps.
EVERY: Final = 50
#: Scene extents. Smaller Gaussians stay, which most are, and hardly one of them is above the bound.
LEAST: Final = 0.01
#: Distances that are worked out at once.
_AT_ONCE: Final = 2**20


def max_scale_ratio_of(setup: Setup) -> float:
    """The bound of a run; 0 where sizes have none.

    By default runs have none that are as long as the published ones or have their rules. Sizes that
    are not trained stay as they are.
    """
    config = setup.config
    if not learns_sizes(setup):
        return 0.0
    if config.max_scale_ratio is not None:
        return config.max_scale_ratio
    return BOUND if is_short(config, setup.schedule) else 0.0


def learns_sizes(setup: Setup) -> bool:
    """Whether there are sizes to bound: primitives are Gaussians with axes that learn."""
    names = gaussians_of(setup)
    learning = (block for block in setup.trained_blocks if block.lr.initial > 0.0)
    return names is not None and names[1] in {name for each in learning for name in each.tensors}


def note_on_sizes(setup: Setup) -> Iterator[str]:
    """That sizes are bounded, where the run did not ask for it."""
    if setup.config.max_scale_ratio is None and (bound := max_scale_ratio_of(setup)):
        yield (
            f"standard deviations are at most {bound:g} of the distance to the nearest training "
            "camera that has a Gaussian at its side (--set max_scale_ratio=0: no bound, as "
            "published)"
        )


def clamp_scales(setup: Setup, state: TrainState) -> None:
    """Shortens axes that are too long, in place, in the steps in which sizes are looked at."""
    if state.step % EVERY:
        return
    names, bound = gaussians_of(setup), max_scale_ratio_of(setup)
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

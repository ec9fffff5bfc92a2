"""A bound on the sizes of Gaussians near cameras.

A splat is drawn as if its Gaussian were small for its distance. A large Gaussian at the side of a
camera, or behind it, spreads over the camera's view, whether or not a training photo shows it
(docs/floaters.md). Cameras that have it in their photo correct its size themselves. The rule is
ours.
"""

from math import log
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from typing_extensions import override

from crossgrad_core.plugin import (
    AfterStepContext,
    Backbone,
    DensifyResult,
    Edit,
    Field,
    Rows,
    Rule,
    Scene,
    hookimpl,
    is_in_image,
)

#: Steps between two looks at the sizes.
EVERY: Final = 50
#: Smaller Gaussians are left alone, in scene extents. Most are smaller, and hardly one of them is
#: above the bound.
LEAST: Final = 0.01
#: Distances that are computed at once.
_AT_ONCE: Final = 2**20


class ScaleClamp(Rule):
    """Bounds the standard deviations of Gaussians by their distance to a camera at their side."""

    ratio: float = Field(
        0.5,
        gt=0,
        description="most that a standard deviation may be of the distance to the nearest training "
        "camera that has a Gaussian at its side",
    )

    @hookimpl
    def crossgrad_after_optimizer(self, context: AfterStepContext) -> DensifyResult | None:
        """Shorten axes that are too long, in the steps in which sizes are looked at."""
        names, scene, ratio = context.backbone.gaussian_tensors, context.scene, self.ratio
        if context.step % EVERY or names is None:
            return None
        positions, scales, _ = (context.parameters[each].detach() for each in names)
        largest = scales.amax(dim=1)
        rows = (largest > log(LEAST)).nonzero().squeeze(1)
        rows = rows[_may_be_near(scene, positions[rows], torch.exp(largest[rows]) / ratio)]
        distances = _nearest_beside(scene, positions[rows].double().cpu().numpy())
        most = torch.from_numpy(np.log(np.maximum(ratio * distances, LEAST))).to(scales)
        # Values that are not finite are left alone; the finiteness check reports them.
        above = (largest[rows] > most) & largest[rows].isfinite()
        rows, most = rows[above], most[above]
        if not len(rows):
            return None
        bounded = Rows(torch.minimum(scales[rows], most[:, None]), rows, keep_moments=True)
        return DensifyResult(Edit(values={names[1]: bounded}))

    @override
    def unused(self, backbone: Backbone, scene: Scene) -> str:
        learns = backbone.learns_scales
        return "" if learns else "the backbone has no Gaussians with axes that learn"


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

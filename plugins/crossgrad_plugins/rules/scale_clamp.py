"""A bound on the sizes of Gaussians near cameras.

A rasterizer projects a Gaussian as if the Gaussian were small compared with its distance. A large
Gaussian beside or behind a camera therefore spreads over the camera's view, and a training photo
may not show it (docs/floaters.md). If the camera's own photo shows the Gaussian, training corrects
the size without this rule. The rule was developed for crossgrad.
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

#: Number of steps between two checks of the sizes.
EVERY: Final = 50
#: Gaussians with a smaller size, in scene extents, are not checked. Most Gaussians are smaller, and
#: hardly any of them exceeds the bound.
LEAST: Final = 0.01
#: Maximum number of distances that are computed at once.
_AT_ONCE: Final = 2**20


class ScaleClamp(Rule):
    """Limits standard deviations of Gaussians by the distance to cameras that do not show them."""

    ratio: float = Field(
        0.5,
        gt=0,
        description="maximum standard deviation of a Gaussian, as a share of its distance to the "
        "nearest training camera that has it at its side",
    )

    @hookimpl
    def crossgrad_after_optimizer(self, context: AfterStepContext) -> DensifyResult | None:
        """Shorten axes that are too long, in each step in which sizes are checked."""
        names, scene, ratio = context.backbone.gaussian_tensors, context.scene, self.ratio
        if context.step % EVERY or names is None:
            return None
        positions, scales, _ = (context.parameters[name].detach() for name in names)
        largest = scales.amax(dim=1)
        rows = (largest > log(LEAST)).nonzero().squeeze(1)
        rows = rows[_may_be_near(scene, positions[rows], torch.exp(largest[rows]) / ratio)]
        distances = _nearest_beside(scene, positions[rows].double().cpu().numpy())
        most = torch.from_numpy(np.log(np.maximum(ratio * distances, LEAST))).to(scales)
        # Leave out values that are not finite, because the finiteness check reports them.
        above = (largest[rows] > most) & largest[rows].isfinite()
        rows, most = rows[above], most[above]
        if not len(rows):
            return None
        bounded = Rows(torch.minimum(scales[rows], most[:, None]), rows, keep_moments=True)
        return DensifyResult(Edit(values={names[1]: bounded}))

    @override
    def unused(self, backbone: Backbone, scene: Scene) -> str:
        learns = backbone.learns_scales
        return "" if learns else "the backbone trains no Gaussians with axes"


def _may_be_near(scene: Scene, positions: Tensor, distances: Tensor) -> Tensor:
    """Return [N] bool: True for all positions [N, 3] nearer than `distances` [N] to any camera.

    A few positions that are farther away may be True as well. The squared distance is computed as a
    product, which is fastest. The product loses precision for large coordinates, so an error bound
    is subtracted.
    """
    centers = torch.from_numpy(scene.centers).to(positions)
    squares, of_centers = (points.square().sum(dim=1) for points in (positions, centers))
    nearest = [
        torch.addmm(of_centers, chunk, centers.T, alpha=-2.0).amin(dim=1)
        for chunk in torch.split(positions, max(1, _AT_ONCE // len(centers)))
    ]
    lost = 16.0 * torch.finfo(positions.dtype).eps * (squares + of_centers.amax())
    return distances.square() > squares + torch.cat(nearest) - lost


def _nearest_beside(scene: Scene, positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return [N] the distance of each position [N, 3] to a camera.

    The camera is the nearest training camera whose photo does not show the position.

    The distance is infinite for positions that all photos show.
    """
    nearest = np.full(len(positions), np.inf)
    for view in scene.train_views:
        apart = np.linalg.norm(positions - view.camera.center.numpy(), axis=1)
        apart[is_in_image(view.camera, positions)] = np.inf
        nearest = np.minimum(nearest, apart)
    return nearest

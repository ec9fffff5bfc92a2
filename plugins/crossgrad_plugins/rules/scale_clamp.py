"""A bound on the sizes of Gaussians near cameras.

A rasterizer projects a Gaussian with an approximation that holds only if the Gaussian is small
compared with its distance. A large Gaussian beside or behind a camera can therefore cover the
camera's whole view, although no training photo shows it (docs/floaters.md). If the camera's own
photo shows the Gaussian, training corrects the size without this rule. This rule was developed for
crossgrad.
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
#: Gaussians below this size, in units of the scene extent, are not checked. Most Gaussians are
#: smaller, and hardly any of them exceeds the bound.
LEAST: Final = 0.01
#: Maximum number of distances that are computed at the same time, to limit memory.
_AT_ONCE: Final = 2**20


class ScaleClamp(Rule):
    """Limits the sizes of Gaussians by their distance to cameras that do not show them."""

    ratio: float = Field(
        0.5,
        gt=0,
        description="maximum standard deviation of a Gaussian, as a share of its distance to the "
        "nearest training camera that has it at its side",
    )

    @hookimpl
    def crossgrad_after_optimizer(self, context: AfterStepContext) -> DensifyResult | None:
        """Shorten axes that are too long, in the steps in which sizes are checked."""
        names, scene, ratio = context.backbone.gaussian_tensors, context.scene, self.ratio
        if context.step % EVERY or names is None:
            return None
        positions, scales, _ = (context.parameters[name].detach() for name in names)
        largest = scales.amax(dim=1)
        rows = (largest > log(LEAST)).nonzero().squeeze(1)
        rows = rows[_may_be_near(scene, positions[rows], torch.exp(largest[rows]) / ratio)]
        distances = _nearest_beside(scene, positions[rows].double().cpu().numpy())
        most = torch.from_numpy(np.log(np.maximum(ratio * distances, LEAST))).to(scales)
        # Skip non-finite values, because the finiteness check reports them.
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
    """Return [N], True for each position [N, 3] that is nearer than `distances` [N] to a camera.

    A few positions that are slightly farther away may also be True. Squared distances are computed
    from products of coordinates, because this form is fastest. This form loses precision for large
    coordinates, so an error bound is subtracted.
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
    """Return [N] the distance of each position [N, 3] to the nearest camera that does not show it.

    Only training cameras are considered.

    The distance is infinite for positions that all photos show.
    """
    nearest = np.full(len(positions), np.inf)
    for view in scene.train_views:
        apart = np.linalg.norm(positions - view.camera.center.numpy(), axis=1)
        apart[is_in_image(view.camera, positions)] = np.inf
        nearest = np.minimum(nearest, apart)
    return nearest

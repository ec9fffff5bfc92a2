"""Gaussians drawn by the rules of programs that show them (`crossgrad eval --file FILE --as NAME`).

Each function returns [H, W, 3] RGB on black. The rules are those of the default settings of the
programs. The rules of GaussianSplats3D (mkkellogg), Spark and CesiumJS were read in their public
sources. The rule of the PlayCanvas engine was taken from a description. If no other rule is stated,
the rules of crossgrad apply (docs/rasterizers.md).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import exp, inf, sqrt
from typing import Final

import torch
from torch import Tensor

from crossgrad_core.numerics.raster_constants import ALPHA_THRESHOLD
from crossgrad_core.plugin import Camera, Gaussians
from crossgrad_plugins.rasterizers.reference.compositing import (
    Drawing,
    composite_tiles,
    splat_table,
    tile_boxes,
    tile_lists,
)
from crossgrad_plugins.rasterizers.reference.harmonics import view_colors
from crossgrad_plugins.rasterizers.reference.projection import Shape, project

#: Number of standard deviations at which all four programs cut a Gaussian.
CUT: Final = sqrt(8.0)
_MAX_ALPHA, _NEAR = 0.99, 1e-3
_LEAST = exp(-CUT * CUT / 2)


def _gaussian(squares: Tensor) -> Tensor:
    return (-0.5 * squares).exp()


def _zero_at_the_cut(squares: Tensor) -> Tensor:
    return (_gaussian(squares) - _LEAST) / (1.0 - _LEAST)


@dataclass(frozen=True)
class Rules:
    """The drawing rules of a program.

    Attributes:
        falloff: Maps the squared distance from the mean, in standard deviations, to the share of
            the opacity.
        dilation: Added to both diagonal entries of the 2-D covariance, px^2.
        compensates: True if the opacity is reduced so that the dilation keeps the Gaussian's mass.
        frame: Gaussians whose centres are farther from the centre of the image than this number of
            half image sizes are not drawn.
        degree: Highest degree of spherical harmonics.
        square: True if the cut is a rectangle along the main axes instead of an ellipse.
        least_variance: Gaussians are not drawn if both variances after dilation are smaller, px^2.
    """

    falloff: Callable[[Tensor], Tensor] = _gaussian
    dilation: float = 0.3
    compensates: bool = False
    frame: float = inf
    degree: int = 3
    square: bool = False
    least_variance: float = 0.0

    def coverage(self, dx: Tensor, dy: Tensor, parameters: Tensor) -> Tensor:
        """Return [P, N] the share of the opacity in each pixel; see `Drawing.coverage`."""
        a, b, c, d = parameters.unbind(-1)
        u, v = a * dx + b * dy, c * dx + d * dy
        squares = u * u + v * v
        inside = torch.maximum(u.abs(), v.abs()) <= CUT if self.square else squares <= CUT * CUT
        return self.falloff(squares) * inside


PLAYCANVAS: Final = Rules(falloff=_zero_at_the_cut)
MKKELLOGG: Final = Rules(frame=1.2, degree=2)
SPARK: Final = Rules(compensates=True, frame=1.4)
# CesiumJS stores 4 times the covariance and uses twice the focal length. Its dilation of 0.3 is
# therefore 16 times, and its least squared size of 4 is 32 times, as large as a variance in px^2.
CESIUM: Final = Rules(dilation=0.3 / 16, frame=1.2, square=True, least_variance=4 / 32)


def playcanvas(gaussians: Gaussians, camera: Camera) -> Tensor:
    """Return [H, W, 3] RGB as the PlayCanvas engine and SuperSplat draw it."""
    return drawn(gaussians, camera, PLAYCANVAS)


def mkkellogg(gaussians: Gaussians, camera: Camera) -> Tensor:
    """Return [H, W, 3] RGB as GaussianSplats3D of mkkellogg draws it."""
    return drawn(gaussians, camera, MKKELLOGG)


def spark(gaussians: Gaussians, camera: Camera) -> Tensor:
    """Return [H, W, 3] RGB as Spark draws it."""
    return drawn(gaussians, camera, SPARK)


def cesium(gaussians: Gaussians, camera: Camera) -> Tensor:
    """Return [H, W, 3] RGB as CesiumJS draws it."""
    return drawn(gaussians, camera, CESIUM)


@torch.no_grad()
def drawn(gaussians: Gaussians, camera: Camera, rules: Rules) -> Tensor:
    """Return [H, W, 3] RGB on black by the rules of a program."""
    gaussians = replace(gaussians, sh_degree=min(gaussians.sh_degree, rules.degree))
    projection = project(gaussians.means, gaussians.quats, gaussians.scales, camera)
    xx, yy, xy = projection.xx + rules.dilation, projection.yy + rules.dilation, projection.xy
    det = projection.det + rules.dilation * (projection.xx + projection.yy) + rules.dilation**2
    opacities = gaussians.opacities
    if rules.compensates:
        opacities = opacities * (projection.det / det).sqrt()
    half = (xx - yy) / 2
    larger = (xx + yy) / 2 + torch.hypot(half, xy)
    angle = 0.5 * torch.atan2(xy, half)
    cosine, sine = angle.cos(), angle.sin()
    first, second = larger.sqrt(), (det / larger).sqrt()
    # These rows map an offset in pixels to standard deviations along the main axes.
    axes = torch.stack([cosine / first, sine / first, -sine / second, cosine / second], -1)
    reach = _reach(opacities, rules)[:, None] * torch.stack([xx, yy], -1).sqrt()
    shapes = Shape(axes, opacities, opacities, reach, reach.amax(-1))
    eye = camera.center.to(gaussians.means)
    table = splat_table(projection.means, projection.depths, view_colors(gaussians, eye), shapes)
    size = (camera.width, camera.height)
    middle = torch.tensor(size).to(projection.means) / 2
    shown = table.isfinite().all(-1) & (projection.depths > _NEAR) & (opacities >= ALPHA_THRESHOLD)
    shown &= ((projection.means - middle).abs() <= rules.frame * middle).all(-1)
    shown &= larger >= rules.least_variance
    index = shown.nonzero().squeeze(-1)
    index = index[projection.depths[index].argsort(stable=True)]
    boxes = tile_boxes(projection.means[index], reach[index], size)
    drawing = Drawing(size, rules.coverage, _MAX_ALPHA, 0)
    return composite_tiles(table[index], tile_lists(boxes, size), drawing)[0][..., :3]


def _reach(opacities: Tensor, rules: Rules) -> Tensor:
    """Return [N] distances in standard deviations beyond which the alpha is below 1/255."""
    reach = (2 * (opacities / ALPHA_THRESHOLD).log().clamp(min=0.0)).sqrt()
    return reach if rules.square else reach.clamp(max=CUT)

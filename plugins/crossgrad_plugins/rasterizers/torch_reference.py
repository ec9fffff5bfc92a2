"""The readable rasterizer: plain PyTorch, any device, float32 or float64, autograd gradients."""

from dataclasses import replace
from typing import ClassVar

import torch
from pydantic import Field
from torch import Tensor
from typing_extensions import override

from crossgrad_core.numerics.raster_constants import ALPHA_THRESHOLD
from crossgrad_core.plugin import Camera, Gaussians, Rasterizer, Render, Response, Screen
from crossgrad_plugins.rasterizers import _speeds
from crossgrad_plugins.rasterizers.footprint import DESCRIPTION, Footprint
from crossgrad_plugins.rasterizers.reference.compositing import (
    TILE,
    Drawing,
    PixelCounter,
    composite_tiles,
    splat_table,
    tile_boxes,
    tile_lists,
)
from crossgrad_plugins.rasterizers.reference.harmonics import view_colors
from crossgrad_plugins.rasterizers.reference.projection import Projection, Shape, project, shape
from crossgrad_plugins.rasterizers.reference.statistics import Recorder, longest_axes, recorded

#: Number of standard deviations of the published radius, and lower bound of the squared half
#: difference of the variances (px^4).
SIGMAS, LEAST_SPREAD = 3.0, 0.1


def published_radii(projection: Projection, dilation: float) -> Tensor:
    """Return [N] half sides of the squares in whole pixels; 0 without an inverse covariance.

    Source: diff-gaussian-rasterization, radius = ceil(3 sqrt(lambda_max)) with lambda_max = mid +
    sqrt(max(0.1, mid^2 - det)); mid is half the trace of the covariance.
    """
    xx, yy = projection.xx + dilation, projection.yy + dilation
    det = projection.det + dilation * (projection.xx + projection.yy) + dilation**2
    spread = ((xx - yy) / 2).square() + projection.xy.square()
    largest = (xx + yy) / 2 + spread.clamp(min=LEAST_SPREAD).sqrt()
    radii = (SIGMAS * largest.sqrt()).ceil()
    valid = (det > 0) & radii.isfinite() & projection.means.isfinite().all(-1)
    return torch.where(valid, radii, 0.0)


def square_boxes(means: Tensor, radii: Tensor, size: tuple[int, int]) -> Tensor:
    """Return [N, 4] int64 tile boxes (x0, y0, x1, y1) that squares around `means` overlap.

    The ends x1 and y1 are excluded. Pixel coordinates start at the centre of the first pixel. A box
    is empty if its radius is 0 or its square is outside the image.
    """
    tiles = torch.tensor([-(-pixels // TILE) for pixels in size]).to(means, non_blocking=True)
    middle = torch.where(radii[:, None] > 0, means, 0.0) - 0.5
    first = ((middle - radii[:, None]) / TILE).floor().clamp(min=0).minimum(tiles)
    last = (((middle + radii[:, None]) / TILE).floor() + 1).clamp(min=0).minimum(tiles)
    box = torch.cat([first, last], -1).long()
    return torch.where(radii[:, None] > 0, box, torch.zeros_like(box))


def common_tiles(boxes: Tensor, others: Tensor) -> Tensor:
    """Return [N, 4] intersections of tile boxes; an empty intersection has equal start and end."""
    first = torch.maximum(boxes[:, :2], others[:, :2])
    last = torch.minimum(boxes[:, 2:], others[:, 2:])
    return torch.cat([first, torch.maximum(first, last)], -1)


_LARGEST_RADIUS = 2.0**30


class TorchRasterizer(Rasterizer):
    """Renders Gaussians by crossgrad's common rules, in the data type of their means.

    Fast rasterizers are tested against this one, so its code is short instead of fast.
    """

    provides: ClassVar[frozenset[str]] = frozenset(
        {"depth", "pixels", "abs_gradient", "directions", "count"}
    )
    responses: ClassVar[frozenset[Response]] = frozenset({"plain", "antialiased", "analytic"})
    devices: ClassVar[frozenset[str]] = frozenset({"cpu", "cuda"})

    footprint: Footprint = Field("alpha", description=DESCRIPTION)

    @classmethod
    @override
    def speed(cls, device: str) -> float:
        return _speeds.torch(device)

    @override
    def render(
        self,
        gaussians: Gaussians,
        camera: Camera,
        background: Tensor,
        outputs: frozenset[str] = frozenset(),
    ) -> Render:
        size = (camera.width, camera.height)
        with torch.no_grad():
            index, boxes, published = self._drawn(gaussians, camera)
        # Gaussians that are not rendered are left out of the graph, so that a NaN in their values
        # has no effect.
        drawn = _rows(gaussians, index)
        projection, shapes, colors = self._splats(drawn, camera)
        screen = Screen(torch.zeros(len(gaussians), dtype=torch.int32, device=index.device))
        table = splat_table(projection.means, projection.depths, colors, shapes)
        axes = None
        if "directions" in outputs:
            axes = longest_axes(projection.factors.detach(), drawn.scales.detach())
        recorder = Recorder(screen, index, len(gaussians), "abs_gradient" in outputs, axes)
        table, probe = recorded(table, recorder)
        drawing = Drawing(size, gaussians.response, self.max_alpha, probe.shape[1])
        table, lists = torch.cat([probe, table], -1), tile_lists(boxes, size)
        channels, touched, blended = composite_tiles(table, lists, drawing)
        radii = shapes.radii.detach().ceil().clamp(min=1, max=_LARGEST_RADIUS)
        screen.radii[index] = torch.where(touched, radii, 0.0).int()
        if published is not None:
            screen.radii = published
        if "pixels" in outputs:
            screen.pixels = torch.zeros_like(screen.radii)
            screen.pixels[index] = blended.int()
        if "count" in outputs:
            screen.count = PixelCounter(table.detach(), lists, drawing, index, len(gaussians))
        colors, depth, alpha = torch.split(channels, [3, 1, 1], -1)
        return Render(
            image=colors + (1 - alpha) * background.to(channels),
            alpha=alpha.squeeze(-1),
            screen=screen,
            depth=depth.squeeze(-1) if "depth" in outputs else None,
        )

    def _splats(self, gaussians: Gaussians, camera: Camera) -> tuple[Projection, Shape, Tensor]:
        projection = project(gaussians.means, gaussians.quats, gaussians.scales, camera)
        dilation = self.dilation if gaussians.dilation is None else gaussians.dilation
        shapes = shape(projection, gaussians.opacities, dilation, gaussians.response)
        eye = camera.center.to(gaussians.means, non_blocking=True)
        return projection, shapes, view_colors(gaussians, eye)

    def _drawn(self, gaussians: Gaussians, camera: Camera) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return the Gaussians to draw, from front to back, their tile boxes [V, 4], and radii.

        The radii [N] int32 are the published radii; they are None unless the footprint is
        `3-sigma`.
        """
        projection, shapes, colors = self._splats(gaussians, camera)
        table = splat_table(projection.means, projection.depths, colors, shapes)
        size = (camera.width, camera.height)
        squares, published = None, None
        if self.footprint == "3-sigma":
            dilation = self._dilation(gaussians)
            radii = published_radii(projection, dilation)
            squares = square_boxes(projection.means, radii, size)
            seen = (projection.depths > self.near) & (squares[:, 2:] > squares[:, :2]).all(-1)
            published = torch.where(seen, radii.clamp(max=_LARGEST_RADIUS), 0.0).int()
        drawn = table.isfinite().all(-1) & shapes.reach.isfinite().all(-1)
        drawn &= (projection.depths > self.near) & (shapes.peaks >= ALPHA_THRESHOLD)
        drawn &= gaussians.opacities >= ALPHA_THRESHOLD
        index = drawn.nonzero().squeeze(-1)
        index = index[projection.depths[index].argsort(stable=True)]
        boxes = tile_boxes(projection.means[index], shapes.reach[index], size)
        if squares is not None:
            boxes = common_tiles(boxes, squares[index])
        seen = (boxes[:, 2:] > boxes[:, :2]).all(-1)
        return index[seen], boxes[seen], published

    def _dilation(self, gaussians: Gaussians) -> float:
        if gaussians.response == "analytic":
            return 0.0
        return self.dilation if gaussians.dilation is None else gaussians.dilation


def _rows(gaussians: Gaussians, index: Tensor) -> Gaussians:
    """Return the Gaussians at the indices `index` [V]."""
    names = ("means", "quats", "scales", "opacities", "colors", "sh_dc", "sh_rest")
    tensors = {name: getattr(gaussians, name) for name in names}
    rows = {name: tensor[index] for name, tensor in tensors.items() if tensor is not None}
    return replace(gaussians, origin=None, **rows)

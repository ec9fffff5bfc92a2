"""Front-to-back compositing, tile by tile, with dense [pixels, Gaussians] tensors."""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import embedding
from torch.utils.checkpoint import checkpoint

from crossgrad_core.numerics.raster_constants import ALPHA_THRESHOLD, TRANSMITTANCE_STOP
from crossgrad_core.plugin import Response
from crossgrad_plugins.rasterizers.reference.projection import Shape, coverage
from crossgrad_plugins.rasterizers.reference.statistics import offsets

#: Number of composited channels: RGB, depth, and ones, whose sum is the accumulated opacity.
CHANNELS = 5
#: With at most this number of (pixel, Gaussian) entries, all intermediate results are stored for
#: the backward pass (about 0.4 GB in float64). With more entries, the backward pass renders each
#: tile again, to save memory.
REMEMBERED_ENTRIES = 2**21
#: Side length of a tile, pixels.
TILE = 16


@dataclass(frozen=True)
class Drawing:
    """The data that all tiles of an image have in common.

    Attributes:
        size: Width and height of the image, pixels.
        response: The response, which determines how alpha depends on the position of a pixel.
        max_alpha: Maximum of alpha; a capped alpha has no gradient.
        probed: Number R of columns for statistics of gradients.
    """

    size: tuple[int, int]
    response: Response
    max_alpha: float
    probed: int


def splat_table(means: Tensor, depths: Tensor, colors: Tensor, shapes: Shape) -> Tensor:
    """Return [N, 7 + S] one row per Gaussian, in the layout that `composite` needs."""
    columns = (means, shapes.opacities[:, None], colors, depths[:, None], shapes.parameters)
    return torch.cat(columns, -1)


@dataclass(frozen=True)
class TileLists:
    """The lists of all tiles, one after the other, with tiles in row-major order.

    Attributes:
        rows: [P] int64 row numbers in the table of Gaussians, from front to back within each tile.
        sizes: Length of each tile's list.
    """

    rows: Tensor
    sizes: list[int]


def composite_tiles(
    table: Tensor, lists: TileLists, drawing: Drawing
) -> tuple[Tensor, Tensor, Tensor]:
    """Blend all tiles of an image.

    Args:
        table: [V, R + 7 + S] the columns for statistics and the columns of `splat_table`, from
            front to back.
        lists: The row numbers of each tile.
        drawing: The data that all tiles have in common.

    Returns:
        `channels` [H, W, 5], `touched` [V] bool and `blended` [V] int64, as in `composite`.
    """
    # Use an embedding, because its backward pass adds in a fixed order on every device. The
    # backward pass of indexing may add in any order.
    tiles = torch.split(embedding(lists.rows, table), lists.sizes)
    again = len(lists.rows) * TILE**2 > REMEMBERED_ENTRIES
    images, touched, blended = [], [], []
    for rows, centers in zip(tiles, _tile_centers(drawing.size, table), strict=True):
        arguments = (rows, centers.flatten(0, 1), drawing)
        if again:
            result = checkpoint(composite, *arguments, use_reentrant=False)
        else:
            result = composite(*arguments)
        images.append(result[0].view(*centers.shape[:2], CHANNELS))
        touched.append(result[1])
        blended.append(result[2])
    across = -(-drawing.size[0] // TILE)
    bands = [torch.cat(images[i : i + across], 1) for i in range(0, len(images), across)]
    counts = torch.stack([torch.cat(touched).long(), torch.cat(blended)], -1)
    totals = counts.new_zeros(len(table), 2).index_add_(0, lists.rows, counts)
    return torch.cat(bands), totals[:, 0] > 0, totals[:, 1]


def _tile_centers(size: tuple[int, int], like: Tensor) -> list[Tensor]:
    """Return [h, w, 2] pixel centres of each tile, in row-major order.

    Tiles at the border can be smaller.
    """
    columns, rows = (torch.arange(n, dtype=like.dtype, device=like.device) + 0.5 for n in size)
    grid = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1)
    return [tile for band in torch.split(grid, TILE) for tile in torch.split(band, TILE, 1)]


def composite(table: Tensor, centers: Tensor, drawing: Drawing) -> tuple[Tensor, Tensor, Tensor]:
    """Blend the Gaussians of a tile over its pixels.

    Args:
        table: [G, R + 7 + S] the columns for statistics and the columns of `splat_table`, from
            front to back.
        centers: [P, 2] pixel centres.
        drawing: The data that all tiles have in common.

    Returns:
        `channels` [P, 5] contains RGB, depth and accumulated opacity, without background. `touched`
        [G] is True if the Gaussian has alpha >= 1/255 in any pixel. `blended` [G] int64 is the
        number of pixels in which the Gaussian was blended.
    """
    touching, blended, weights = _blends(table, centers, drawing)
    colors_depths = table[:, drawing.probed + 3 : drawing.probed + 7]
    features = torch.cat([colors_depths, torch.ones_like(colors_depths[:, :1])], -1)
    return weights @ features, touching.any(0), blended.sum(0)


@dataclass(frozen=True, eq=False)
class PixelCounter:
    """Counts the blended pixels of a rendered view; see `Screen.count`.

    Attributes:
        table: [V, R + 7 + S] table of `composite_tiles`, without gradients.
        lists: The row numbers of each tile.
        drawing: The data that all tiles have in common.
        index: [V] int64 index of the Gaussian of each row.
        total: Number N of all Gaussians.
    """

    table: Tensor
    lists: TileLists
    drawing: Drawing
    index: Tensor
    total: int

    @torch.no_grad()
    def __call__(self, marked: Tensor) -> Tensor:
        """Return [N] int32: in how many marked pixels [H, W] each Gaussian was blended."""
        rows = self.lists.rows
        tiles = torch.split(self.table[rows], self.lists.sizes)
        blend_counts = rows.new_zeros(len(rows))
        first = 0
        for tile, centers in zip(tiles, _tile_centers(self.drawing.size, self.table), strict=True):
            column, row = centers.long().flatten(0, 1).unbind(-1)
            _, blended, _ = _blends(tile, centers.flatten(0, 1), self.drawing)
            blend_counts[first : first + len(tile)] = blended[marked[row, column]].sum(0)
            first += len(tile)
        counts = rows.new_zeros(self.total)
        return counts.index_add_(0, self.index[rows], blend_counts).int()


def _blends(table: Tensor, centers: Tensor, drawing: Drawing) -> tuple[Tensor, Tensor, Tensor]:
    """Return three [P, G] arrays: alpha >= 1/255, the Gaussian was blended, blending weight."""
    columns = [drawing.probed, 2, 1, 4, table.shape[1] - drawing.probed - 7]
    probe, means, opacities, _, parameters = torch.split(table, columns, -1)
    dx, dy = offsets(means, probe, centers, drawing.size)
    alpha = opacities.T * coverage(dx, dy, parameters, drawing.response)
    alpha = alpha.clamp(max=drawing.max_alpha)
    touching = alpha >= ALPHA_THRESHOLD
    alpha = torch.where(touching, alpha, 0.0)
    # The transmittance behind each Gaussian, as if compositing did not stop.
    after = (1 - alpha).cumprod(-1)
    before = torch.cat([torch.ones_like(after[:, :1]), after], -1)[:, :-1]
    # Transmittance never increases. If a Gaussian stops compositing, all Gaussians behind it are
    # therefore excluded too.
    blended = touching & (after >= TRANSMITTANCE_STOP)
    return touching, blended, torch.where(blended, alpha * before, 0.0)


def tile_boxes(means: Tensor, reach: Tensor, size: tuple[int, int]) -> Tensor:
    """Return [N, 4] int64 tile boxes (x0, y0, x1, y1) without their ends; empty if outside.

    Args:
        means: [N, 2] projected means, pixels; they must be finite.
        reach: [N, 2] half-extents of the footprints, pixels.
        size: Width and height of the image, pixels.
    """
    # Add one pixel on each side, so that rounding does not cut off a part of a footprint.
    low, high = means - reach - 1, means + reach + 1
    limit = torch.tensor(size).to(means, non_blocking=True)
    seen = (high > 0) & (low < limit)
    first = (low.clamp(min=0).minimum(limit) / TILE).floor().long()
    last = (high.clamp(min=0).minimum(limit) / TILE).ceil().long()
    return torch.cat([first, torch.where(seen.all(-1, keepdim=True), last, first)], -1)


def tile_lists(boxes: Tensor, size: tuple[int, int]) -> TileLists:
    """Return the lists of all tiles for `boxes` [N, 4] in order of depth."""
    across, down = (-(-pixels // TILE) for pixels in size)
    x0, y0, x1, y1 = boxes.unbind(-1)
    counts = (x1 - x0) * (y1 - y0)
    rows = torch.arange(len(boxes), device=boxes.device).repeat_interleave(counts)
    number_in_box = torch.arange(len(rows), device=boxes.device) - (counts.cumsum(0) - counts)[rows]
    columns = (x1 - x0)[rows]
    tiles = (y0[rows] + number_in_box // columns) * across + x0[rows] + number_in_box % columns
    order = tiles.argsort(stable=True)
    return TileLists(rows[order], torch.bincount(tiles, minlength=across * down).tolist())

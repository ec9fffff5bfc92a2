"""Which Gaussians each 16 x 16 tile of pixels has to look at, in depth order."""

from dataclasses import dataclass

import torch
from torch import Tensor

#: Side of a tile, pixels.
TILE = 16


@dataclass(frozen=True)
class TileLists:
    """Lists of all tiles, one after the other, tiles in row-major order.

    Attributes:
        rows: [P] int64 rows of the Gaussians' table, front to back within each tile.
        sizes: Length of each tile's list.
    """

    rows: Tensor
    sizes: list[int]


def tile_boxes(means: Tensor, reach: Tensor, size: tuple[int, int]) -> Tensor:
    """[N, 4] int64 tile boxes (x0, y0, x1, y1), ends excluded; empty where off the image.

    Args:
        means: [N, 2] pixels; finite.
        reach: [N, 2] half-extents, pixels.
        size: Width and height of the image, pixels.
    """
    # One pixel of slack so that no rounding here can cut a footprint.
    low, high = means - reach - 1, means + reach + 1
    limit = torch.tensor(size).to(means, non_blocking=True)
    seen = (high > 0) & (low < limit)
    first = (low.clamp(min=0).minimum(limit) / TILE).floor().long()
    last = (high.clamp(min=0).minimum(limit) / TILE).ceil().long()
    return torch.cat([first, torch.where(seen.all(-1, keepdim=True), last, first)], -1)


def tile_lists(boxes: Tensor, size: tuple[int, int]) -> TileLists:
    """Fills the lists of all tiles from `boxes` [N, 4], which are in depth order."""
    across, down = (-(-pixels // TILE) for pixels in size)
    x0, y0, x1, y1 = boxes.unbind(-1)
    counts = (x1 - x0) * (y1 - y0)
    rows = torch.arange(len(boxes), device=boxes.device).repeat_interleave(counts)
    place = torch.arange(len(rows), device=boxes.device) - (counts.cumsum(0) - counts)[rows]
    columns = (x1 - x0)[rows]
    tiles = (y0[rows] + place // columns) * across + x0[rows] + place % columns
    order = tiles.argsort(stable=True)
    return TileLists(rows[order], torch.bincount(tiles, minlength=across * down).tolist())

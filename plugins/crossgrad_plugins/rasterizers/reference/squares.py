"""The footprint of the original 3DGS code: the tiles of a square of three standard deviations."""

import torch
from torch import Tensor

from crossgrad_plugins.rasterizers.reference.projection import Projection
from crossgrad_plugins.rasterizers.reference.tiles import TILE

#: Standard deviations, and the least square of half the difference of the variances, px^4.
SIGMAS, LEAST_SPREAD = 3.0, 0.1


def published_radii(projection: Projection, dilation: float) -> Tensor:
    """[N] half-sides of the squares, whole pixels; 0 where there is no inverse covariance.

    Source: diff-gaussian-rasterization, radius = ceil(3 sqrt(lambda_max)) with lambda_max = mid +
    sqrt(max(0.1, mid^2 - det)).
    """
    xx, yy = projection.xx + dilation, projection.yy + dilation
    det = projection.det + dilation * (projection.xx + projection.yy) + dilation**2
    spread = ((xx - yy) / 2).square() + projection.xy.square()
    largest = (xx + yy) / 2 + spread.clamp(min=LEAST_SPREAD).sqrt()
    radii = (SIGMAS * largest.sqrt()).ceil()
    valid = (det > 0) & radii.isfinite() & projection.means.isfinite().all(-1)
    return torch.where(valid, radii, 0.0)


def square_boxes(means: Tensor, radii: Tensor, size: tuple[int, int]) -> Tensor:
    """[N, 4] int64 tile boxes (x0, y0, x1, y1) that squares around `means` overlap, ends excluded.

    Pixels are numbered from the centre of the first one here. Empty where the radius is 0 or the
    square is off the image.
    """
    tiles = torch.tensor([-(-pixels // TILE) for pixels in size]).to(means, non_blocking=True)
    middle = torch.where(radii[:, None] > 0, means, 0.0) - 0.5
    first = ((middle - radii[:, None]) / TILE).floor().clamp(min=0).minimum(tiles)
    last = (((middle + radii[:, None]) / TILE).floor() + 1).clamp(min=0).minimum(tiles)
    box = torch.cat([first, last], -1).long()
    return torch.where(radii[:, None] > 0, box, torch.zeros_like(box))


def common_tiles(boxes: Tensor, others: Tensor) -> Tensor:
    """[N, 4] tile boxes that both have; an end not beyond its start where there are none."""
    first = torch.maximum(boxes[:, :2], others[:, :2])
    last = torch.minimum(boxes[:, 2:], others[:, 2:])
    return torch.cat([first, torch.maximum(first, last)], -1)

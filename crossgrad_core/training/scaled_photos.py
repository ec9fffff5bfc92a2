"""Photos in a smaller size, by an area filter, in a bounded amount of memory."""

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from crossgrad_core.contract.scene import View
from crossgrad_core.scene.photos import PhotoCache

#: Photo [H, W, 3] uint8 and mask [H, W] bool, None where every pixel counts.
Pair = tuple[Tensor, Tensor | None]
#: A pixel counts where at least this share of what it covers does.
_COUNTS = 0.5


@dataclass(frozen=True)
class ScaledPhoto:
    """A view's photo in another size.

    Attributes:
        view: The view.
        width: Pixels.
        height: Pixels.
        full: Gives the photo and the mask as trained.
    """

    view: View
    width: int
    height: int
    full: Callable[[View], Pair] = field(compare=False)

    def decode(self) -> Pair:
        """The photo and the mask in this size."""
        return reduced(*self.full(self.view), self.width, self.height)


class ScaledPhotos:
    """Reduced photos that were asked for; those of more memory than `mib` are made again.

    Args:
        mib: Memory in MiB; the latest photo is kept in any case.
    """

    def __init__(self, mib: int) -> None:
        self._cache: PhotoCache[ScaledPhoto] = PhotoCache(mib)

    def get(self, photo: ScaledPhoto) -> Pair:
        """The photo and mask in that size; shared, so never to be written to."""
        return self._cache.get(photo)


def reduced(image: Tensor, mask: Tensor | None, width: int, height: int) -> Pair:
    """Image and mask averaged by area: each new pixel is the mean of what it covers.

    Pixels that do not count are left out of the means; a new pixel counts where at least half of
    what it covers does. Every step is exact or elementwise, so that no bit depends on threads.

    Args:
        image: [H, W, 3] uint8.
        mask: [H, W] bool, or None.
        width: At most W.
        height: At most H.
    """
    kept = torch.ones(image.shape[:2], dtype=torch.float64, device=image.device)
    if mask is not None:
        kept = mask.to(torch.float64)
    cover = _areas(kept, width, height)
    # One channel after the other: a large photo in float64 takes much memory.
    sums = [_areas(image[..., channel] * kept, width, height) for channel in range(image.shape[2])]
    means = torch.stack(sums, dim=-1) / torch.where(cover > 0, cover, 1.0)[..., None]
    small = means.round().clamp(0, 255).to(torch.uint8)
    if mask is None:
        return small, None
    whole = (image.shape[0] / height) * (image.shape[1] / width)
    counts = cover >= _COUNTS * whole
    return small, None if bool(counts.all()) else counts


def _areas(values: Tensor, width: int, height: int) -> Tensor:
    """[height, width] sums of [H, W] over the area that each new pixel covers."""
    rows = _covered(values, height)
    return _covered(rows.T, width).T.contiguous()


def _covered(values: Tensor, count: int) -> Tensor:
    """[count, ...] sums of [N, ...] float64 over `count` equal stretches of the first dimension."""
    length = values.shape[0]
    total = torch.cat([torch.zeros_like(values[:1]), values.cumsum(dim=0)])
    edges = torch.arange(count + 1, dtype=torch.float64, device=values.device) * (length / count)
    whole = edges.floor().clamp(max=length - 1).to(torch.int64)
    part = (edges - whole)[:, None]
    at_edges = total[whole] + part * values[whole]
    return at_edges[1:] - at_edges[:-1]

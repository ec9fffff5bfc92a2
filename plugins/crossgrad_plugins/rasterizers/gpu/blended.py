"""The number of pixels in which each Gaussian was blended, from gsplat's lists."""

from collections.abc import Callable, Mapping
from typing import Any, Final

import torch
from torch import Tensor

_NAMES: Final = ("means2d", "conics", "opacities", "isect_offsets", "flatten_ids")
#: Number of pixels per call of gsplat. gsplat lists all Gaussians of each pixel and needs 24 bytes
#: per entry, so a larger number could need too much memory.
PIXELS: Final = 1 << 19
#: A number that is larger than the number of batches of Gaussians in any tile.
_ALL: Final = 1 << 30


def counter(meta: Mapping[str, Any], view: int) -> Callable[[Tensor], Tensor]:
    """Return the function `Screen.count` of a rendered view.

    While the function exists, the projected data and the tile lists stay in memory.

    Args:
        meta: The metadata that gsplat's `rasterization` returns.
        view: Index of the view among the K views.
    """
    projected: dict[str, Tensor] = {name: meta[name].detach() for name in _NAMES}
    width, height, tile_size = meta["width"], meta["height"], meta["tile_size"]

    def count(marked: Tensor) -> Tensor:
        from gsplat import rasterize_to_indices_in_range

        opacities = projected["opacities"]
        total: Tensor = opacities.new_zeros(opacities.shape[-1], dtype=torch.int64)
        rows = max(1, PIXELS // width)
        for first in range(0, height, rows):
            # gsplat skips pixels that are already opaque. Set the transmittance of unmarked pixels
            # to 0, so that gsplat skips these pixels too.
            light = opacities.new_zeros((*opacities.shape[:-1], height, width))
            band = slice(first, first + rows)
            light[view, 0, band] = marked[band].to(light)
            gaussian_ids, _, _ = rasterize_to_indices_in_range(
                0,
                _ALL,
                light,
                projected["means2d"],
                projected["conics"],
                opacities,
                width,
                height,
                tile_size,
                projected["isect_offsets"],
                projected["flatten_ids"],
            )
            total += torch.bincount(gaussian_ids, minlength=len(total))
        return total.int()

    return count

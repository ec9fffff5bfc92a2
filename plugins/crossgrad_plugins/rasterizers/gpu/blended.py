"""Counts of pixels in which Gaussians were blended, from gsplat's lists of intersections."""

from collections.abc import Callable, Mapping
from typing import Any, Final

import torch
from torch import Tensor

_NAMES: Final = ("means2d", "conics", "opacities", "isect_offsets", "flatten_ids")
#: Pixels that are looked at in one call: gsplat lists each Gaussian of each, 24 bytes.
PIXELS: Final = 1 << 19
#: More batches of Gaussians than a tile has.
_ALL: Final = 1 << 30


def counter(meta: Mapping[str, Any], view: int) -> Callable[[Tensor], Tensor]:
    """The function `Screen.count` of a view; keeps what was projected and the tile lists alive.

    Args:
        meta: What gsplat's `rasterization` says besides the image.
        view: Which of the K views.
    """
    known: dict[str, Tensor] = {name: meta[name].detach() for name in _NAMES}
    width, height, tile_size = meta["width"], meta["height"], meta["tile_size"]

    def count(marked: Tensor) -> Tensor:
        from gsplat import rasterize_to_indices_in_range

        opacities = known["opacities"]
        total: Tensor = opacities.new_zeros(opacities.shape[-1], dtype=torch.int64)
        rows = max(1, PIXELS // width)
        for first in range(0, height, rows):
            # A pixel through which no light comes is left out, as one that is opaque would be.
            light = opacities.new_zeros((*opacities.shape[:-1], height, width))
            band = slice(first, first + rows)
            light[view, 0, band] = marked[band].to(light)
            found, _, _ = rasterize_to_indices_in_range(
                0,
                _ALL,
                light,
                known["means2d"],
                known["conics"],
                opacities,
                width,
                height,
                tile_size,
                known["isect_offsets"],
                known["flatten_ids"],
            )
            total += torch.bincount(found, minlength=len(total))
        return total.int()

    return count

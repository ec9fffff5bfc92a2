"""The pixels that a Gaussian may touch: an option of crossgrad's own rasterizers."""

from typing import Literal, TypeAlias

#: `alpha`: all pixels with alpha >= 1/255. `3-sigma`: only the pixels in 16 x 16 tiles that overlap
#: a square of ceil(3 standard deviations) around the mean (3DGS, recipe `published`).
Footprint: TypeAlias = Literal["alpha", "3-sigma"]

DESCRIPTION = (
    "size of the rendered footprint: alpha: all pixels with alpha >= 1/255; "
    "3-sigma: as in the original code"
)

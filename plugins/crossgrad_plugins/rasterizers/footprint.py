"""The option `footprint` of crossgrad's own rasterizers: the pixels that a Gaussian may touch."""

from typing import Literal, TypeAlias

#: `alpha` allows all pixels with alpha >= 1/255. `3-sigma` allows only pixels in 16 x 16 tiles that
#: overlap a square of ceil(3 standard deviations) around the mean, as in 3DGS and recipe
#: `published`.
Footprint: TypeAlias = Literal["alpha", "3-sigma"]

DESCRIPTION = (
    "size of the rendered footprint: alpha: all pixels with alpha >= 1/255; "
    "3-sigma: as in the original code"
)

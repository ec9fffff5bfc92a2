"""Which pixels a Gaussian may touch: an option of our rasterizers."""

from typing import Literal, TypeAlias

#: `alpha`: all where alpha >= 1/255. `3-sigma`: of these the ones in the 16 x 16 tiles that a
#: square of ceil(3 standard deviations) around the mean overlaps (3DGS, recipe `published`).
Footprint: TypeAlias = Literal["alpha", "3-sigma"]

DESCRIPTION = "alpha: all pixels with alpha >= 1/255; 3-sigma: as the original code"

"""Sizes and the layout of a drawn Gaussian's record, shared by all kernels.

The 2-D Gaussian is kept by rows of pixels, which is well conditioned even for needles: with
covariance [[A, B], [B, C]] (dilated), row offset dy and column offset dx from the mean,

    exponent = -(dy^2 / C + (dx - k dy)^2 / V) / 2,   k = B / C,   V = (A C - B^2) / C,

so a row is a 1-D Gaussian of variance V around k dy. Exponents are in units of log 2.
"""

import math

from crossgrad_core.numerics.raster_constants import ALPHA_THRESHOLD

#: Pixels of a tile.
TILE_WIDTH = 64
TILE_HEIGHT = 16
#: A patch is 4 x 4 pixels, worked on together in vectors whose lanes are its pixels column by
#: column: what the rows have in common is then a plain load. A tile's patches are numbered along
#: its rows of patches, and are as many as an integer has bits.
SIDE = 4
COLUMNS = TILE_WIDTH // SIDE
#: Pixels from a tile's first column to the one from which columns are counted: the shorter the way,
#: the finer is a place in float32.
MIDDLE = TILE_WIDTH // 2
PATCHES = COLUMNS * TILE_HEIGHT // SIDE

#: Gaussians that one job of the projection handles.
CHUNK = 2048

#: Floats of a record (one cache line), and what is where.
RECORD = 16
U_WHOLE, U_PART = 0, 1  # projected mean, pixels: whole and fractional part
V_WHOLE, V_PART = 2, 3
SLOPE = 4  # k
ROW_DECAY = 5  # log2(e) / (2 C)
DECAY = 6  # log2(e) / (2 V)
WIDTH = 7  # 1 / DECAY
LOG_OPACITY = 8  # log2 of the opacity (with the antialiasing factor)
RED, GREEN, BLUE = 9, 10, 11
DEPTH = 12

#: A record of the analytic response has these instead of SLOPE to LOG_OPACITY.
COSINE, SINE = 4, 5  # of the longer main axis
INVERSE_1, INVERSE_2 = 6, 7  # 1 / standard deviation along each main axis, 1 / pixels
PEAK = 8  # opacity times 2 pi times both standard deviations
REACH_1, REACH_2 = 13, 14  # offsets along the main axes beyond which nothing is touched, pixels
RADIUS = 15  # squared, in sigmas beyond half a pixel, likewise for both axes together

#: Sums over pixels that the backward pass leaves per drawn Gaussian and tile.
PARTIAL = 16
SUM_1, SUM_D, SUM_Y, SUM_DD, SUM_YY, SUM_DY = 0, 1, 2, 3, 4, 5
SUM_RED, SUM_GREEN, SUM_BLUE = 6, 7, 8
SUM_DEPTH = 9
SUM_ABS_X, SUM_ABS_Y = 10, 11
#: Of the analytic response instead of SUM_D to SUM_DY.
SUM_U, SUM_V, SUM_SIGMA_1, SUM_SIGMA_2, SUM_TURN = 1, 2, 3, 4, 5

LOG2_E = 1.0 / math.log(2.0)
#: A pixel is touched where the exponent plus log2 of the opacity reaches this.
TOUCH = math.log2(ALPHA_THRESHOLD)
#: Row extents are computed with this much to spare, so that rounding loses no touched pixel.
SPARE = 1e-4

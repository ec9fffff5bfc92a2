"""Sizes of a tile, and where things are in its scratch memory.

Rows are kept interleaved, [column * 3 + channel]: a step of one column is three floats.
"""

from crossgrad_core.numerics.simd import WIDE
from crossgrad_plugins.losses.photometric.reference import RADIUS, WINDOW

TILE_ROWS = 64
TILE_COLUMNS = 384
#: Rows of a ring; a power of two, more than WINDOW: those of two rows overlap.
SLOTS = 16
CHANNELS = 3
#: Floats of the columns that a window reaches beyond its centre.
HALO = CHANNELS * RADIUS
# Room for a tile with twice the halo on both sides, and for vectors that start before its end.
_ROOM = CHANNELS * TILE_COLUMNS + 4 * HALO + CHANNELS * WINDOW + 3 * WIDE
STRIDE = _ROOM + -_ROOM % WIDE

#: Ring of s - centre.
SUM = 0
#: Ring of d - centre.
DIFFERENCE = SUM + SLOTS * STRIDE
#: Ring of 1 where a pixel counts, else 0.
KEEP = DIFFERENCE + SLOTS * STRIDE
#: s, s^2, d, d^2 of two rows, summed down the columns.
PARTIAL = KEEP + SLOTS * STRIDE
#: Rings of a, b, c.
BY_MEAN = PARTIAL + 8 * STRIDE
BY_SUM_VARIANCE = BY_MEAN + SLOTS * STRIDE
BY_DIFFERENCE_VARIANCE = BY_SUM_VARIANCE + SLOTS * STRIDE
#: a, b, c of two rows, summed down the columns.
BACK = BY_DIFFERENCE_VARIANCE + SLOTS * STRIDE
#: A row of results.
LINE = BACK + 6 * STRIDE
#: What is subtracted from s and from d.
CENTRE_SUM = LINE + STRIDE
CENTRE_DIFFERENCE = CENTRE_SUM + STRIDE
#: Floats in all.
SCRATCH = CENTRE_DIFFERENCE + STRIDE

"""A tile's patches: their lanes as rows of pixels and back, and where they lie."""

from crossgrad_core.numerics.simd import (
    LANES,
    WIDE,
    Lanes,
    first_half,
    joined,
    last_half,
    picking,
)
from crossgrad_plugins.rasterizers.numba_kernels.jit import device
from crossgrad_plugins.rasterizers.numba_kernels.layout import COLUMNS, SIDE

_PLACES = [(x, y) for x in range(SIDE) for y in range(SIDE)]
# Of two rows of eight pixels, then two more: the patch on the left and the one on the right.
_left_patch, _right_patch = (
    picking([y * LANES + start + x for x, y in _PLACES]) for start in (0, SIDE)
)
# Of the patch on the left and the one on the right: the first and the last two rows of pixels.
_first_rows, _last_rows = (
    picking([x // SIDE * WIDE + x % SIDE * SIDE + y for y in rows for x in range(LANES)])
    for rows in ((0, 1), (2, 3))
)


@device
def row_of(patch: int) -> int:
    """Returns the first row of pixels of a patch."""
    return (patch // COLUMNS) * SIDE


@device
def column_of(patch: int) -> int:
    """Returns the column of patches."""
    return patch & (COLUMNS - 1)


@device
def place_of(x: int, y: int) -> tuple[int, int]:
    """Returns the patch of pixel (x, y) of a tile, and its lane there."""
    return (y // SIDE) * COLUMNS + x // SIDE, (x % SIDE) * SIDE + y % SIDE


@device
def two_patches(a: Lanes, b: Lanes, c: Lanes, d: Lanes) -> tuple[Lanes, Lanes]:
    """Returns two patches, side by side, of four rows of eight pixels."""
    above, below = joined(a, b), joined(c, d)
    return _left_patch(above, below), _right_patch(above, below)


@device
def four_rows(left: Lanes, right: Lanes) -> tuple[Lanes, Lanes, Lanes, Lanes]:
    """Returns the four rows of eight pixels of two patches side by side."""
    above, below = _first_rows(left, right), _last_rows(left, right)
    return first_half(above), last_half(above), first_half(below), last_half(below)

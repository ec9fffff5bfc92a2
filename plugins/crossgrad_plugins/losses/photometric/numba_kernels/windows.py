"""Sums over the 11-wide Gaussian window, across columns and down the rows of a ring."""

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jit import device
from crossgrad_core.numerics.simd import Lanes, fma, load_wide, splat_wide
from crossgrad_plugins.losses.photometric.numba_kernels.layout import CHANNELS, SLOTS, STRIDE
from crossgrad_plugins.losses.photometric.reference import RADIUS, gaussian_window

_Floats = NDArray[np.float32]
_Taps = tuple[Lanes, Lanes, Lanes, Lanes, Lanes, Lanes, Lanes, Lanes, Lanes, Lanes, Lanes, Lanes]
_LAST = SLOTS - 1
_W0, _W1, _W2, _W3, _W4, _W5 = (np.float32(w) for w in gaussian_window().numpy()[: RADIUS + 1])


@device
def across(array: _Floats, start: int) -> Lanes:
    """Window sum over eleven columns, the first of them at element `start`."""
    total = load_wide(array, start + 5 * CHANNELS) * splat_wide(_W5)
    pair = load_wide(array, start + 4 * CHANNELS) + load_wide(array, start + 6 * CHANNELS)
    total = fma(pair, splat_wide(_W4), total)
    pair = load_wide(array, start + 3 * CHANNELS) + load_wide(array, start + 7 * CHANNELS)
    total = fma(pair, splat_wide(_W3), total)
    pair = load_wide(array, start + 2 * CHANNELS) + load_wide(array, start + 8 * CHANNELS)
    total = fma(pair, splat_wide(_W2), total)
    pair = load_wide(array, start + CHANNELS) + load_wide(array, start + 9 * CHANNELS)
    total = fma(pair, splat_wide(_W1), total)
    pair = load_wide(array, start) + load_wide(array, start + 10 * CHANNELS)
    return fma(pair, splat_wide(_W0), total)


@device
def _tap(ring: _Floats, start: int, row: int) -> Lanes:
    """Column `start` of a row of the ring."""
    return load_wide(ring, start + (row & _LAST) * STRIDE)


@device
def _taps(ring: _Floats, start: int, row: int) -> _Taps:
    """The twelve rows that the windows around `row` and the row below it reach."""
    return (
        _tap(ring, start, row - 5),
        _tap(ring, start, row - 4),
        _tap(ring, start, row - 3),
        _tap(ring, start, row - 2),
        _tap(ring, start, row - 1),
        _tap(ring, start, row),
        _tap(ring, start, row + 1),
        _tap(ring, start, row + 2),
        _tap(ring, start, row + 3),
        _tap(ring, start, row + 4),
        _tap(ring, start, row + 5),
        _tap(ring, start, row + 6),
    )


@device
def _sum(
    a: Lanes, b: Lanes, c: Lanes, d: Lanes, e: Lanes, middle: Lanes,
    f: Lanes, g: Lanes, h: Lanes, i: Lanes, j: Lanes,
) -> Lanes:  # fmt: skip
    """Window sum of eleven rows."""
    total = middle * splat_wide(_W5)
    total = fma(e + f, splat_wide(_W4), total)
    total = fma(d + g, splat_wide(_W3), total)
    total = fma(c + h, splat_wide(_W2), total)
    total = fma(b + i, splat_wide(_W1), total)
    return fma(a + j, splat_wide(_W0), total)


@device
def _sum_squares(
    a: Lanes, b: Lanes, c: Lanes, d: Lanes, e: Lanes, middle: Lanes,
    f: Lanes, g: Lanes, h: Lanes, i: Lanes, j: Lanes,
) -> Lanes:  # fmt: skip
    """Window sum of the squares of eleven rows."""
    total = middle * middle * splat_wide(_W5)
    total = fma(fma(e, e, f * f), splat_wide(_W4), total)
    total = fma(fma(d, d, g * g), splat_wide(_W3), total)
    total = fma(fma(c, c, h * h), splat_wide(_W2), total)
    total = fma(fma(b, b, i * i), splat_wide(_W1), total)
    return fma(fma(a, a, j * j), splat_wide(_W0), total)


@device
def down(ring: _Floats, start: int, row: int) -> tuple[Lanes, Lanes]:
    """Window sums over the rows of a ring around `row` and around the next one.

    Both at once: what they need comes from the second-level cache, and is mostly the same.

    Args:
        ring: Rows, of which `SLOTS` are kept.
        start: Element where the column begins.
        row: Number of a row.
    """
    a, b, c, d, e, f, g, h, i, j, k, last = _taps(ring, start, row)
    return (
        _sum(a, b, c, d, e, f, g, h, i, j, k),
        _sum(b, c, d, e, f, g, h, i, j, k, last),
    )


@device
def down_with_squares(ring: _Floats, start: int, row: int) -> tuple[Lanes, Lanes, Lanes, Lanes]:
    """As `down`: the sums of the values and of their squares, then the same around the next row."""
    a, b, c, d, e, f, g, h, i, j, k, last = _taps(ring, start, row)
    return (
        _sum(a, b, c, d, e, f, g, h, i, j, k),
        _sum_squares(a, b, c, d, e, f, g, h, i, j, k),
        _sum(b, c, d, e, f, g, h, i, j, k, last),
        _sum_squares(b, c, d, e, f, g, h, i, j, k, last),
    )

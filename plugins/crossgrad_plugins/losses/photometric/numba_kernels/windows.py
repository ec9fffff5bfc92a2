"""Sums over the 11-wide Gaussian window, across columns and down the rows of a ring."""

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jit import device
from crossgrad_core.numerics.simd import Lanes, fma, load, splat
from crossgrad_plugins.losses.photometric.numba_kernels.layout import CHANNELS, SLOTS, STRIDE
from crossgrad_plugins.losses.photometric.reference import RADIUS, gaussian_window

_Floats = NDArray[np.float32]
_LAST = SLOTS - 1
_W0, _W1, _W2, _W3, _W4, _W5 = (np.float32(w) for w in gaussian_window().numpy()[: RADIUS + 1])


@device
def across(array: _Floats, start: int) -> Lanes:
    """Window sum over eleven columns, the first of them at element `start`."""
    total = load(array, start + 5 * CHANNELS) * splat(_W5)
    pair = load(array, start + 4 * CHANNELS) + load(array, start + 6 * CHANNELS)
    total = fma(pair, splat(_W4), total)
    pair = load(array, start + 3 * CHANNELS) + load(array, start + 7 * CHANNELS)
    total = fma(pair, splat(_W3), total)
    pair = load(array, start + 2 * CHANNELS) + load(array, start + 8 * CHANNELS)
    total = fma(pair, splat(_W2), total)
    pair = load(array, start + CHANNELS) + load(array, start + 9 * CHANNELS)
    total = fma(pair, splat(_W1), total)
    pair = load(array, start) + load(array, start + 10 * CHANNELS)
    return fma(pair, splat(_W0), total)


@device
def _tap(ring: _Floats, start: int, row: int) -> Lanes:
    """Column `start` of a row of the ring."""
    return load(ring, start + (row & _LAST) * STRIDE)


@device
def down(ring: _Floats, start: int, row: int) -> Lanes:
    """Window sum over rows row - 5 .. row + 5 of the ring whose column is at element `start`."""
    total = _tap(ring, start, row) * splat(_W5)
    pair = _tap(ring, start, row - 1) + _tap(ring, start, row + 1)
    total = fma(pair, splat(_W4), total)
    pair = _tap(ring, start, row - 2) + _tap(ring, start, row + 2)
    total = fma(pair, splat(_W3), total)
    pair = _tap(ring, start, row - 3) + _tap(ring, start, row + 3)
    total = fma(pair, splat(_W2), total)
    pair = _tap(ring, start, row - 4) + _tap(ring, start, row + 4)
    total = fma(pair, splat(_W1), total)
    pair = _tap(ring, start, row - 5) + _tap(ring, start, row + 5)
    return fma(pair, splat(_W0), total)


@device
def _add_pair(
    ring: _Floats, start: int, row: int, reach: int, weight: Lanes, sums: tuple[Lanes, Lanes]
) -> tuple[Lanes, Lanes]:
    """Adds the rows `reach` above and below, and their squares."""
    above, below = _tap(ring, start, row - reach), _tap(ring, start, row + reach)
    squares = fma(above, above, below * below)
    return fma(above + below, weight, sums[0]), fma(squares, weight, sums[1])


@device
def down_with_squares(ring: _Floats, start: int, row: int) -> tuple[Lanes, Lanes]:
    """Window sums over rows row - 5 .. row + 5 of the ring's values and of their squares."""
    middle = _tap(ring, start, row)
    weight = splat(_W5)
    sums = (middle * weight, middle * middle * weight)
    sums = _add_pair(ring, start, row, 1, splat(_W4), sums)
    sums = _add_pair(ring, start, row, 2, splat(_W3), sums)
    sums = _add_pair(ring, start, row, 3, splat(_W2), sums)
    sums = _add_pair(ring, start, row, 4, splat(_W1), sums)
    return _add_pair(ring, start, row, 5, splat(_W0), sums)

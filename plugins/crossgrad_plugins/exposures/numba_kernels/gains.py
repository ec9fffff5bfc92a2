"""Gains in linear light on sRGB values, and their gradients (CPU, float32, one thread).

The sRGB curve is linear for dark values, and a power function above them. If a value x is in the
power part before and after the gain G, the whole computation is one linear map. The map is x ->
G^(1/2.4) (x + o) - o with o = 0.055. If x is in the linear part before and after the gain, the map
is x -> G x. Only values that move from one part to the other need a power function. Such values are
searched for in blocks of eight.
"""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jit import device, kernel
from crossgrad_core.numerics.simd import (
    LANES,
    Lanes,
    bits,
    load,
    lowest_bit,
    splat,
    store,
    where,
)
from crossgrad_plugins.exposures.srgb import (
    EXPONENT,
    OFFSET,
    SLOPE,
    STRETCH,
    THRESHOLD,
    THRESHOLD_LINEAR,
)

_Floats: TypeAlias = NDArray[np.float32]
_Sums: TypeAlias = NDArray[np.float64]

#: Number of values after which the channels start again in the first SIMD lane.
PERIOD = 3 * LANES
# Number of blocks that are summed in float32 before their sum is added in float64.
_ROUNDS = 32
_ALL = np.uint64(2**LANES - 1)

_ZERO = np.float32(0)
_OFFSET, _STRETCH = np.float32(OFFSET), np.float32(STRETCH)
_SLOPE, _EXPONENT = np.float32(SLOPE), np.float32(EXPONENT)
_ROOT = np.float32(1.0 / EXPONENT)
_THRESHOLD, _THRESHOLD_LINEAR = np.float32(THRESHOLD), np.float32(THRESHOLD_LINEAR)
# Derivative with respect to stops, divided by f + o in the power part and by f in the linear part;
# f is the value after the gain.
_OF_POWER, _OF_LINE = np.log(2.0) / EXPONENT, np.log(2.0)


@device
def _exposed(value: np.float32, gain: np.float32) -> np.float32:
    """Return one value after the gain."""
    if value <= _THRESHOLD:
        light = gain * value / _SLOPE
    else:
        light = gain * ((value + _OFFSET) / _STRETCH) ** _EXPONENT
    if light <= _THRESHOLD_LINEAR:
        return _SLOPE * light
    return _STRETCH * light**_ROOT - _OFFSET


@device
def _slope(value: np.float32, taken: np.float32, gain: np.float32) -> np.float32:
    """Return the derivative of the value after the gain by the value before the gain."""
    if taken <= _THRESHOLD:
        if value <= _THRESHOLD:
            return gain
        return _EXPONENT * taken / (value + _OFFSET)
    if value <= _THRESHOLD:
        return (taken + _OFFSET) / (_EXPONENT * value)
    return (taken + _OFFSET) / (value + _OFFSET)


@device
def _sides(values: Lanes, straight: Lanes, bright: Lanes) -> tuple[np.uint64, np.uint64]:
    """Return two bit masks of a block of values.

    They mark the values that stay in the linear part of the curve, and the values that stay in the
    power part.
    """
    dark = splat(_THRESHOLD)
    both = bits(values <= dark) & bits(straight <= dark)
    return both, _ALL & ~bits(values <= dark) & ~bits(bright <= dark)


@kernel
def expose(image: _Floats, gains: _Floats, slopes: _Floats, taken: _Floats) -> None:
    """Write the values after the gain.

    Args:
        image: Values in the order R, G, B, R ...
        gains: [24] the gains of the channels, repeated.
        slopes: [24] the gains of the channels to the power of 1 / 2.4, repeated.
        taken: Output, as long as `image`.
    """
    offset, dark = splat(_OFFSET), splat(_THRESHOLD)
    whole = len(image) // PERIOD * PERIOD
    for start in range(0, whole, PERIOD):
        for lane in range(0, PERIOD, LANES):
            values = load(image, start + lane)
            straight = load(gains, lane) * values
            bright = load(slopes, lane) * (values + offset) - offset
            store(taken, start + lane, where(values <= dark, straight, bright))
            on_line, on_power = _sides(values, straight, bright)
            crossing = _ALL & ~(on_line | on_power)
            while crossing != 0:
                j = lane + lowest_bit(crossing)
                taken[start + j] = _exposed(image[start + j], gains[j])
                crossing &= crossing - np.uint64(1)
    for j in range(whole, len(image)):
        taken[j] = _exposed(image[j], gains[j - whole])


@kernel
def expose_back(
    image: _Floats, taken: _Floats, upstream: _Floats, gains: _Floats, gradient: _Floats,
    sums: _Sums,
) -> None:  # fmt: skip
    """Write the gradient with respect to the values, and add up the one for each channel's stops.

    Args:
        image: The image, as for `expose`.
        taken: The output of `expose`.
        upstream: The gradient with respect to the output of `expose`.
        gains: [24], as for `expose`.
        gradient: Output: the gradient with respect to the values.
        sums: [3] output: the gradient with respect to the stops; must be zero at the start.
    """
    partial = np.zeros((2, PERIOD), dtype=np.float32)
    flat = partial.ravel()
    zero, dark, offset, exponent = (
        splat(_ZERO), splat(_THRESHOLD), splat(_OFFSET), splat(_EXPONENT),
    )  # fmt: skip
    whole = len(image) // PERIOD * PERIOD
    for start in range(0, whole, PERIOD):
        for lane in range(0, PERIOD, LANES):
            values, after = load(image, start + lane), load(taken, start + lane)
            given = load(upstream, start + lane)
            before_line, after_line = values <= dark, after <= dark
            # If a gain moves a value out of the linear part of the curve, the divisor is the value
            # times the exponent of the power part.
            below = where(before_line, exponent * values, values + offset)
            above = where(after_line, exponent * after, after + offset)
            slope = where(
                before_line, where(after_line, load(gains, lane), above / below), above / below
            )
            store(gradient, start + lane, given * slope)
            of_line, of_power = given * after, given * (after + offset)
            store(flat, lane, load(flat, lane) + where(after_line, of_line, zero))
            rest = PERIOD + lane
            store(flat, rest, load(flat, rest) + where(after_line, zero, of_power))
        if start // PERIOD % _ROUNDS == 0:
            _settle(partial, sums)
    _settle(partial, sums)
    for j in range(whole, len(image)):
        gradient[j] = upstream[j] * _slope(image[j], taken[j], gains[j - whole])
        sums[j % 3] += _by_stops(taken[j]) * upstream[j]


@device
def _by_stops(taken: np.float32) -> float:
    """Return the derivative of one value after the gain with respect to the stops."""
    if taken <= _THRESHOLD:
        return _OF_LINE * taken
    return _OF_POWER * (taken + _OFFSET)


@device
def _settle(partial: _Floats, sums: _Sums) -> None:
    """Add the sums of the linear part and of the power part to the sums of the channels."""
    for j in range(PERIOD):
        of_line, of_power = np.float64(partial[0, j]), np.float64(partial[1, j])
        sums[j % 3] += _OF_LINE * of_line + _OF_POWER * of_power
        partial[0, j], partial[1, j] = _ZERO, _ZERO

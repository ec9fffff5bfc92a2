"""Adam by rows: steps of the rows that have a gradient, and steps without one, many at a time.

Bit for bit what `fused` does to a whole tensor. A gradient of zero leaves of a step

    m = beta1 m,   v = beta2 v,   p -= step_size * (m / (sqrt(v) * root_scale + eps))

with the flushes to zero of `coefficients`, so that eight elements take any number of steps in
registers: memory is read and written once.
"""

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jit import device, kernel
from crossgrad_core.numerics.jobs import Jobs, take
from crossgrad_core.numerics.simd import (
    LANES,
    Lanes,
    bits,
    broadcast,
    fma,
    fnma,
    larger,
    load,
    magnitude,
    prefetch_write,
    splat,
    square_root,
    store,
    where,
)
from crossgrad_core.training.adam.coefficients import SMALLEST_NORMAL, TINY
from crossgrad_core.training.adam.numba_kernels.fused import Numbers, update

Floats = NDArray[np.float32]
Ints = NDArray[np.int32]

#: Numbers of a step in a table of steps: both betas, step size, scale of the root, eps, and of this
#: and all later steps the largest step size and the smallest scale of the root.
BETA1, BETA2, STEP_SIZE, ROOT_SCALE, EPS, MOST, LEAST = range(7)
NUMBERS = 7

#: Rows that one task works on; a few of them fit into the second cache with their moments.
_ROWS = 1024
_GATHERED = 128
#: Elements of a cache line, and rows that memory is asked for ahead of time.
_LINE, _AHEAD = 16, 6
#: Steps between two looks at whether a parameter still moves.
_LOOK = 32
#: A step of less than half a unit in the last place (2^-25 or more) leaves a parameter as it is;
#: half of that is kept for the rounding of the estimate.
_STILL = np.float32(2.0**-26)
# Second moments above it stay normal numbers for `_LOOK` steps of beta2 >= 1/2.
_STEADY = np.float32(2.0**-90)
_ALL = np.uint64(2**LANES - 1)
_ZERO = np.float32(0.0)
_TINY, _SMALLEST_NORMAL = np.float32(TINY), np.float32(SMALLEST_NORMAL)


@device
def _rests(p: Lanes, m: Lanes, v: Lanes, steps: Floats, row: int) -> bool:
    """Whether no step from `row` of the table on changes a bit of the eight parameters.

    The moments' quotient |m| / sqrt(v) falls from step to step while v is a normal number.
    """
    zero = splat(_ZERO)
    root = where(splat(_STEADY) <= v, square_root(v), zero)
    reach = broadcast(steps, row + MOST) * magnitude(m)
    bound = splat(_STILL) * magnitude(p) * (root * broadcast(steps, row + LEAST))
    return bits(reach <= bound) == _ALL


@device
def _eight(
    p_at: Floats, m_at: Floats, v_at: Floats, at: int, first: int, end: int, steps: Floats
) -> None:
    """Takes the steps from `first` to before `end` of the table with eight elements."""
    zero, tiny, normal = splat(_ZERO), splat(_TINY), splat(_SMALLEST_NORMAL)
    p, m, v = load(p_at, at), load(m_at, at), load(v_at, at)
    if bits(larger(magnitude(m), v) <= zero) == _ALL:
        return
    k = first
    while k < end:
        stop = min(k + _LOOK, end)
        rests = _rests(p, m, v, steps, k * NUMBERS)
        for step in range(k, stop):
            row = step * NUMBERS
            m = broadcast(steps, row + BETA1) * m
            m = where(magnitude(m) < tiny, zero, m)
            v = broadcast(steps, row + BETA2) * v
            v = where(v < normal, zero, v)
            if not rests:
                eps = broadcast(steps, row + EPS)
                root = fma(square_root(v), broadcast(steps, row + ROOT_SCALE), eps)
                p = fnma(broadcast(steps, row + STEP_SIZE), m / root, p)
        k = stop
    store(p_at, at, p)
    store(m_at, at, m)
    store(v_at, at, v)


@device
def _row(
    p: Floats,
    m: Floats,
    v: Floats,
    at: int,
    width: int,
    first: int,
    end: int,
    steps: Floats,
    rest: Floats,
) -> None:
    """Takes the steps from `first` to before `end` with the `width` elements from `at` on."""
    whole = width - width % LANES
    for start in range(at, at + whole, LANES):
        _eight(p, m, v, start, first, end, steps)
    left = width - whole
    if left == 0:
        return
    p_rest, m_rest, v_rest = rest[:LANES], rest[LANES : 2 * LANES], rest[2 * LANES :]
    for i in range(left):
        p_rest[i], m_rest[i], v_rest[i] = p[at + whole + i], m[at + whole + i], v[at + whole + i]
    for i in range(left, LANES):
        p_rest[i] = m_rest[i] = v_rest[i] = _ZERO
    _eight(p_rest, m_rest, v_rest, 0, first, end, steps)
    for i in range(left):
        p[at + whole + i], m[at + whole + i], v[at + whole + i] = p_rest[i], m_rest[i], v_rest[i]


@device
def _bring_near(rows: Ints, k: int, width: int, p: Floats, m: Floats, v: Floats) -> None:
    """Asks for the memory of row k of the list, if there is one, before it is needed."""
    if k >= rows.size:
        return
    at = np.intp(rows[k]) * width
    for i in range(0, width + _LINE - 1, _LINE):
        here = at + min(i, width - 1)
        prefetch_write(p, here)
        prefetch_write(m, here)
        prefetch_write(v, here)


@kernel
def catch_up(
    jobs: Jobs,
    whole: bool,
    rows: Ints,
    width: int,
    param: Floats,
    exp_avg: Floats,
    exp_avg_sq: Floats,
    done: Ints,
    before: int,
    steps: Floats,
) -> None:
    """Takes the steps without gradient that rows of a tensor are behind.

    Args:
        jobs: From `share`.
        whole: Whether all rows are meant.
        rows: [R] the rows, each once, where not all are meant.
        width: Elements of a row.
        param: [N * width].
        exp_avg: [N * width].
        exp_avg_sq: [N * width].
        done: [N] steps that each row has had; written.
        before: Steps before the first of the table; no row has had fewer.
        steps: [T * NUMBERS] the steps since.
    """
    count = done.size if whole else rows.size
    end = steps.size // NUMBERS
    rest = np.empty(3 * LANES, np.float32)
    task = take(jobs)
    while task * _ROWS < count:
        for place in range(task * _ROWS, min(count, (task + 1) * _ROWS)):
            ahead = place + _AHEAD
            if not whole and ahead < count and done[rows[ahead]] - before < end:
                _bring_near(rows, ahead, width, param, exp_avg, exp_avg_sq)
            i = np.intp(place) if whole else np.intp(rows[place])
            first = np.intp(done[i]) - before
            if first < end:
                _row(param, exp_avg, exp_avg_sq, i * width, width, first, end, steps, rest)
                done[i] = before + end
        task = take(jobs)


@device
def _copied(source: Floats, at: int, target: Floats, to: int, width: int) -> None:
    """Copies `width` elements; eight at a time, the last of which may be copied twice."""
    if width < LANES:
        for i in range(width):
            target[to + i] = source[at + i]
        return
    for i in range(0, width - LANES, LANES):
        store(target, to + i, load(source, at + i))
    store(target, to + width - LANES, load(source, at + width - LANES))


@kernel
def update_rows(
    jobs: Jobs,
    rows: Ints,
    width: int,
    param: Floats,
    grad: Floats,
    exp_avg: Floats,
    exp_avg_sq: Floats,
    numbers: Numbers,
) -> None:
    """Takes one step with rows of a tensor and their gradients.

    Args:
        jobs: From `share`.
        rows: [R], each once.
        width: Elements of a row.
        param: [N * width].
        grad: [R * width].
        exp_avg: [N * width].
        exp_avg_sq: [N * width].
        numbers: Of the step, as in `fused`.
    """
    places = np.empty((3, _GATHERED * width), np.float32)
    task = take(jobs)
    while task * _ROWS < rows.size:
        last = min(rows.size, (task + 1) * _ROWS)
        for first in range(task * _ROWS, last, _GATHERED):
            end = min(first + _GATHERED, last)
            size = (end - first) * width
            p, m, v = places[0, :size], places[1, :size], places[2, :size]
            for k in range(first, end):
                _bring_near(rows, k + _AHEAD, width, param, exp_avg, exp_avg_sq)
                at, to = np.intp(rows[k]) * width, (k - first) * width
                _copied(param, at, p, to, width)
                _copied(exp_avg, at, m, to, width)
                _copied(exp_avg_sq, at, v, to, width)
            update(p, grad[first * width : end * width], m, v, numbers)
            for k in range(first, end):
                at, to = np.intp(rows[k]) * width, (k - first) * width
                _copied(p, to, param, at, width)
                _copied(m, to, exp_avg, at, width)
                _copied(v, to, exp_avg_sq, at, width)
        task = take(jobs)

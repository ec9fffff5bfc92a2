"""Adam by rows: one step for rows with a gradient, or many steps for rows without a gradient.

The results are bit-identical to the results of `fused` for a whole tensor. With a gradient of zero,
a step changes parameter p, first moment m and second moment v:

    m = beta1 m,   v = beta2 v,   p -= step_size * (m / (sqrt(v) * root_scale + eps))

Small values of the moments m and v become 0, as described in `coefficients`. Eight elements take
all their steps in registers, so that their memory is read and written only once.
"""

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jit import device, kernel
from crossgrad_core.numerics.jobs import Jobs, next_job
from crossgrad_core.numerics.simd import (
    LANES,
    WIDE,
    Lanes,
    bits,
    broadcast,
    fma,
    fnma,
    larger,
    load,
    load_wide,
    magnitude,
    prefetch_write,
    splat,
    splat_wide,
    square_root,
    store,
    where,
)
from crossgrad_core.training.adam.coefficients import LARGEST, SMALLEST_NORMAL, TINY
from crossgrad_core.training.adam.numba_kernels.fused import Numbers, moves, update

Floats = NDArray[np.float32]
Ints = NDArray[np.int32]

#: Columns of a table of steps: both betas, step size, scale of the square root, eps, largest step
#: size, smallest scale of the square root. The last two columns are the extreme values over the
#: present step and all later steps.
BETA1, BETA2, STEP_SIZE, ROOT_SCALE, EPS, MOST, LEAST = range(7)
NUMBERS = 7

#: `_ROWS`: number of rows in one job. `_GATHERED`: number of short rows that are copied into
#: contiguous memory for one call of `update`.
_ROWS = 1024
_GATHERED = 128
#: Number of gradient elements that `update_all` gathers at a time. This number of elements fills
#: complete cache lines for rows of any width. The gathered gradients fit into the first-level cache
#: together with their parameters and moments.
_AT_ONCE = 768
#: Largest number of consecutive long rows that are updated in one call.
_SIDE_BY_SIDE = 16
#: `_LINE`: number of float32 elements in a cache line. `_AHEAD`: how many rows in advance a row is
#: prefetched.
_LINE, _AHEAD = 16, 6
#: Number of steps between two checks whether the parameters still change.
_LOOK = 32
#: A step below 2^-25 of a parameter (half a unit in the last place) does not change the parameter.
#: The limit here is 2^-26, because the estimate itself has rounding errors.
_STILL = np.float32(2.0**-26)
# Second moments above this value stay normal numbers for `_LOOK` steps with beta2 >= 1/2.
_STEADY = np.float32(2.0**-90)
_ALL = np.uint64(2**LANES - 1)
_ZERO = np.float32(0.0)
_TINY, _SMALLEST_NORMAL, _LARGEST = (np.float32(v) for v in (TINY, SMALLEST_NORMAL, LARGEST))


@device
def _rests(p: Lanes, m: Lanes, v: Lanes, steps: Floats, row: int) -> bool:
    """Return True if no step from `row` of the table on changes any of the eight parameters.

    The function uses that |m| / sqrt(v) decreases with every step while v is a normal number.
    """
    zero = splat(_ZERO)
    root = where(splat(_STEADY) <= v, square_root(v), zero)
    reach = broadcast(steps, row + MOST) * magnitude(m)
    bound = splat(_STILL) * magnitude(p) * (root * broadcast(steps, row + LEAST))
    return bits(reach <= bound) == _ALL


@device
def _eight(
    p: Lanes, m: Lanes, v: Lanes, first: int, end: int, steps: Floats
) -> tuple[Lanes, Lanes, Lanes]:
    """Apply the steps `first` to `end - 1` of the table to eight elements."""
    zero, tiny, normal = splat(_ZERO), splat(_TINY), splat(_SMALLEST_NORMAL)
    k = end if bits(larger(magnitude(m), v) <= zero) == _ALL else first
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
    return p, m, v


@device
def _bring_near(rows: Ints, k: int, width: int, p: Floats, m: Floats, v: Floats) -> None:
    """Prefetch the parameters and moments of the k-th listed row, if the list has so many rows."""
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
    """Apply deferred steps, which have no gradient, to rows of a tensor.

    Args:
        jobs: Job counters, passed by `parallel`.
        whole: True to update all rows.
        rows: [R] the rows to update, without duplicates; unused if `whole` is True.
        width: Number of elements in a row.
        param: [N * width] values of the tensor.
        exp_avg: [N * width] first moments.
        exp_avg_sq: [N * width] second moments.
        done: [N] number of steps that each row has taken; updated.
        before: Number of steps before the first step of the table. Every row has taken these
            earlier steps.
        steps: [T * NUMBERS] the table of steps.
    """
    count = done.size if whole else rows.size
    end = steps.size // NUMBERS
    left = width % LANES
    # Buffer for the last elements of a row, which do not fill a SIMD vector. The unused lanes stay
    # zero.
    rest = np.zeros(3 * LANES, np.float32)
    tasks = (count + _ROWS - 1) // _ROWS
    task = next_job(jobs, tasks)
    while task < tasks:
        for index in range(task * _ROWS, min(count, (task + 1) * _ROWS)):
            ahead = index + _AHEAD
            if not whole and ahead < count and done[rows[ahead]] - before < end:
                _bring_near(rows, ahead, width, param, exp_avg, exp_avg_sq)
            i = np.intp(index) if whole else np.intp(rows[index])
            first = np.intp(done[i]) - before
            if first >= end:
                continue
            at = i * width
            for _ in range(width // LANES):
                p, m, v = load(param, at), load(exp_avg, at), load(exp_avg_sq, at)
                p, m, v = _eight(p, m, v, first, end, steps)
                store(param, at, p)
                store(exp_avg, at, m)
                store(exp_avg_sq, at, v)
                at += LANES
            if left:
                for c in range(left):
                    rest[c] = param[at + c]
                    rest[LANES + c] = exp_avg[at + c]
                    rest[2 * LANES + c] = exp_avg_sq[at + c]
                p, m, v = load(rest, 0), load(rest, LANES), load(rest, 2 * LANES)
                p, m, v = _eight(p, m, v, first, end, steps)
                store(rest, 0, p)
                store(rest, LANES, m)
                store(rest, 2 * LANES, v)
                for c in range(left):
                    param[at + c] = rest[c]
                    exp_avg[at + c] = rest[LANES + c]
                    exp_avg_sq[at + c] = rest[2 * LANES + c]
            done[i] = before + end
        task = next_job(jobs, tasks)


@device
def _stepped(
    p: Lanes, m: Lanes, v: Lanes, g: Lanes, numbers: Numbers
) -> tuple[Lanes, Lanes, Lanes]:
    """Apply one step to sixteen elements with their gradient, as in `update`."""
    beta1, new1, beta2, new2, step_size, root_scale, eps, square_floor, scale = numbers
    zero, tiny, most = splat_wide(_ZERO), splat_wide(_TINY), splat_wide(_LARGEST)
    least = splat_wide(-_LARGEST)
    g = splat_wide(scale) * g
    # Comparisons with NaN are false, so NaN is preserved.
    g = where(most < g, most, where(g < least, least, g))
    g = where(magnitude(g) < tiny, zero, g)
    m = fma(splat_wide(beta1), m, splat_wide(new1) * g)
    m = where(magnitude(m) < tiny, zero, m)
    g = where(magnitude(g) < splat_wide(square_floor), zero, g)
    v = fma(splat_wide(beta2), v, splat_wide(new2) * g * g)
    v = where(v < splat_wide(_SMALLEST_NORMAL), zero, v)
    root = fma(square_root(v), splat_wide(root_scale), splat_wide(eps))
    return fnma(splat_wide(step_size), m / root, p), m, v


@device
def _step_row(
    row: int,
    width: int,
    drawn: bool,
    grad_row: int,
    param: Floats,
    grad: Floats,
    exp_avg: Floats,
    exp_avg_sq: Floats,
    numbers: Numbers,
) -> None:
    """Apply one step to a row of at least `WIDE` elements.

    If the row was rendered, its gradient is row `grad_row` of `grad`; otherwise its gradient is
    zero.
    """
    at, begin, g = row * width, grad_row * width, splat_wide(_ZERO)
    # The row is processed in groups of sixteen elements. The last group may overlap with the group
    # before. Compute the last group first, because the group before overwrites the shared elements.
    tail = at + width - WIDE
    if drawn:
        g = load_wide(grad, begin + width - WIDE)
    p, m, v = load_wide(param, tail), load_wide(exp_avg, tail), load_wide(exp_avg_sq, tail)
    p_tail, m_tail, v_tail = _stepped(p, m, v, g, numbers)
    for i in range(0, width - WIDE, WIDE):
        here = at + i
        if drawn:
            g = load_wide(grad, begin + i)
        p, m, v = load_wide(param, here), load_wide(exp_avg, here), load_wide(exp_avg_sq, here)
        p, m, v = _stepped(p, m, v, g, numbers)
        store(param, here, p)
        store(exp_avg, here, m)
        store(exp_avg_sq, here, v)
    store(param, tail, p_tail)
    store(exp_avg, tail, m_tail)
    store(exp_avg_sq, tail, v_tail)


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
    """Apply one step to the rows of a tensor that have a gradient.

    Args:
        jobs: Job counters, passed by `parallel`.
        rows: [R] row numbers, sorted and unique. Consecutive rows are updated as one piece of
            memory.
        width: Number of elements in a row.
        param: [N * width] values of the tensor.
        grad: [R * width] gradients of the listed rows.
        exp_avg: [N * width] first moments.
        exp_avg_sq: [N * width] second moments.
        numbers: The coefficients of the step, as in `fused`.
    """
    wide = width >= WIDE
    room, together = (0, _SIDE_BY_SIDE) if wide else (_GATHERED * width, _GATHERED)
    ps, ms, vs = np.empty(room, np.float32), np.empty(room, np.float32), np.empty(room, np.float32)
    tasks = (rows.size + _ROWS - 1) // _ROWS
    task = next_job(jobs, tasks)
    while task < tasks:
        last = min(rows.size, (task + 1) * _ROWS)
        for first in range(task * _ROWS, last, together):
            stop = min(first + together, last)
            source, size = first * width, (stop - first) * width
            if rows[stop - 1] - rows[first] == stop - 1 - first:
                a, b = np.intp(rows[first]) * width, (np.intp(rows[stop - 1]) + 1) * width
                pulls = grad[source : source + size]
                update(param[a:b], pulls, exp_avg[a:b], exp_avg_sq[a:b], numbers)
                continue
            for k in range(first, stop if wide else first):
                _bring_near(rows, k + _AHEAD, width, param, exp_avg, exp_avg_sq)
                row = np.intp(rows[k])
                _step_row(row, width, True, k, param, grad, exp_avg, exp_avg_sq, numbers)
            if wide:
                continue
            for k in range(first, stop):
                at, to = np.intp(rows[k]) * width, (k - first) * width
                for i in range(width):
                    ps[to + i], ms[to + i] = param[at + i], exp_avg[at + i]
                    vs[to + i] = exp_avg_sq[at + i]
            update(ps[:size], grad[source : source + size], ms[:size], vs[:size], numbers)
            for k in range(first, stop):
                at, to = np.intp(rows[k]) * width, (k - first) * width
                for i in range(width):
                    param[at + i], exp_avg[at + i] = ps[to + i], ms[to + i]
                    exp_avg_sq[at + i] = vs[to + i]
        task = next_job(jobs, tasks)


@kernel
def update_all(
    jobs: Jobs,
    rows: Ints,
    width: int,
    param: Floats,
    grad: Floats,
    exp_avg: Floats,
    exp_avg_sq: Floats,
    numbers: Numbers,
) -> None:
    """Apply one step to all rows of a tensor; rows that are not listed have a gradient of zero.

    Args:
        jobs: Job counters, passed by `parallel`.
        rows: [R] indices of the rows with a gradient, sorted and unique.
        width: Number of elements in a row.
        param: [N * width] values of the tensor.
        grad: [R * width] gradients of the listed rows.
        exp_avg: [N * width] first moments.
        exp_avg_sq: [N * width] second moments.
        numbers: The coefficients of the step, as in `fused`.
    """
    count, together = param.size // width, _LINE * max(1, _AT_ONCE // _LINE // width)
    pulls = np.zeros(together * width, np.float32)
    tasks = (count + _ROWS - 1) // _ROWS
    task = next_job(jobs, tasks)
    while task < tasks:
        end = min(count, (task + 1) * _ROWS)
        next_row = np.searchsorted(rows, task * _ROWS)
        for first in range(task * _ROWS, end, together):
            stop = min(first + together, end)
            a, b, begin = first * width, stop * width, next_row
            while next_row < rows.size and rows[next_row] < stop:
                next_row += 1
            drawn = next_row - begin
            if drawn == stop - first:
                given = grad[begin * width : next_row * width]
                update(param[a:b], given, exp_avg[a:b], exp_avg_sq[a:b], numbers)
                continue
            if not drawn and not moves(pulls[: b - a], exp_avg[a:b], exp_avg_sq[a:b]):
                continue
            if width < WIDE:
                for k in range(begin, next_row):
                    at, to = k * width, (np.intp(rows[k]) - first) * width
                    for i in range(width):
                        pulls[to + i] = grad[at + i]
                update(param[a:b], pulls[: b - a], exp_avg[a:b], exp_avg_sq[a:b], numbers)
                pulls[: b - a] = _ZERO
                continue
            for row in range(first, stop):
                has_gradient = begin < next_row and rows[begin] == row
                _step_row(
                    row, width, has_gradient, begin, param, grad, exp_avg, exp_avg_sq, numbers
                )
                begin += has_gradient
        task = next_job(jobs, tasks)

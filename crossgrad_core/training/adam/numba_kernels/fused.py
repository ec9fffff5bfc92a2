"""Adam's update of float32 tensors in a single pass over memory (Numba, CPU)."""

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numba import carray
from numpy.typing import NDArray

from crossgrad_core.gradients.numba_kernels.pointers import float32_pointer
from crossgrad_core.numerics.jit import kernel
from crossgrad_core.numerics.jobs import Jobs, next_job, parallel, serial
from crossgrad_core.training.adam.coefficients import LARGEST, SMALLEST_NORMAL, TINY, Coefficients

# Number of elements in one job. The number is fixed, so that results do not depend on the number of
# threads.
_CHUNK = 1 << 16
# Number of elements that are skipped together if their gradients and moments are all zero.
_RUN = 1 << 13

_ZERO = np.float32(0)
_TINY, _SMALLEST_NORMAL, _LARGEST = (np.float32(v) for v in (TINY, SMALLEST_NORMAL, LARGEST))

_Floats: TypeAlias = NDArray[np.float32]
_Number: TypeAlias = np.float32
Numbers: TypeAlias = tuple[
    _Number, _Number, _Number, _Number, _Number, _Number, _Number, _Number, _Number
]


@kernel
def update(
    param: _Floats, grad: _Floats, exp_avg: _Floats, exp_avg_sq: _Floats, numbers: Numbers
) -> None:
    """Apply one step in place to `param`, `exp_avg` and `exp_avg_sq`.

    All arrays are 1-D and have equal length.
    """
    beta1, new1, beta2, new2, step_size, root_scale, eps, square_floor, scale = numbers
    for i in range(len(param)):
        g = scale * grad[i]
        g = min(max(g, -_LARGEST), _LARGEST)  # With this order of arguments, a NaN stays a NaN.
        g = _ZERO if abs(g) < _TINY else g
        m = beta1 * exp_avg[i] + new1 * g
        m = _ZERO if abs(m) < _TINY else m
        g = _ZERO if abs(g) < square_floor else g
        v = beta2 * exp_avg_sq[i] + new2 * g * g
        v = _ZERO if v < _SMALLEST_NORMAL else v
        exp_avg[i] = m
        exp_avg_sq[i] = v
        param[i] -= step_size * (m / (np.sqrt(v) * root_scale + eps))


@kernel
def moves(grad: _Floats, exp_avg: _Floats, exp_avg_sq: _Floats) -> bool:
    """Return True if any gradient or moment is not 0.

    If all are 0, the Adam step changes nothing.
    """
    few = min(64, len(grad))
    for end in (few, len(grad)):
        count = 0
        for i in range(end):
            count += (grad[i] != _ZERO) | (exp_avg[i] != _ZERO) | (exp_avg_sq[i] != _ZERO)
        if count:
            return True
    return False


@kernel
def _update_chunks(
    jobs: Jobs,
    addresses: NDArray[np.int64],
    sizes: NDArray[np.int64],
    numbers: _Floats,
    from_zero: NDArray[np.bool_],
) -> None:
    """Apply one step to all tensors; the work is split into chunks of elements.

    Args:
        jobs: Job counters, passed by `parallel`.
        addresses: [T, 4] memory addresses of the values, the gradient and the two moments of each
            tensor.
        sizes: [T] number of elements of each tensor.
        numbers: [T, 9] coefficients of each tensor's step.
        from_zero: [T], True if a tensor is uninitialised. Before the step, the kernel sets the
            values of uninitialised tensors to zero.
    """
    chunks = 0
    for size in sizes:
        chunks += (size + _CHUNK - 1) // _CHUNK
    job = next_job(jobs, chunks)
    while job < chunks:
        tensor, chunk = 0, job
        while chunk * _CHUNK >= sizes[tensor]:
            chunk -= (sizes[tensor] + _CHUNK - 1) // _CHUNK
            tensor += 1
        size = sizes[tensor]
        param = carray(float32_pointer(addresses[tensor, 0]), size)
        grad = carray(float32_pointer(addresses[tensor, 1]), size)
        exp_avg = carray(float32_pointer(addresses[tensor, 2]), size)
        exp_avg_sq = carray(float32_pointer(addresses[tensor, 3]), size)
        n = numbers[tensor]
        of_step = (n[0], n[1], n[2], n[3], n[4], n[5], n[6], n[7], n[8])
        for a in range(chunk * _CHUNK, min(size, (chunk + 1) * _CHUNK), _RUN):
            b = min(size, a + _RUN)
            if from_zero[tensor]:
                param[a:b] = _ZERO
            if moves(grad[a:b], exp_avg[a:b], exp_avg_sq[a:b]):
                update(param[a:b], grad[a:b], exp_avg[a:b], exp_avg_sq[a:b], of_step)
        job = next_job(jobs, chunks)


def numbers_of(step: Coefficients) -> Numbers:
    """Return the coefficients of a step as float32.

    A learning rate beyond float32 becomes infinite.
    """
    # Ignore the overflow here, because the check of the parameters finds the infinite values.
    with np.errstate(over="ignore"):
        return (
            np.float32(step.beta1),
            np.float32(1 - step.beta1),
            np.float32(step.beta2),
            np.float32(1 - step.beta2),
            np.float32(step.step_size),
            np.float32(step.root_scale),
            np.float32(step.eps),
            np.float32(step.square_floor),
            np.float32(step.scale),
        )


def update_at(
    addresses: Sequence[Sequence[int]], sizes: Sequence[int], steps: Sequence[Coefficients]
) -> None:
    """Apply a step to each of T tensors, in place.

    Args:
        addresses: [T, 4] memory addresses of the values, the gradient and the two moments of each
            tensor, which are float32 and contiguous.
        sizes: [T] number of elements of each tensor.
        steps: [T] coefficients of the step of each tensor.
    """
    numbers = np.array([numbers_of(step) for step in steps], np.float32).reshape(-1, 9)
    # For a single chunk of elements, starting other threads takes longer than the update itself.
    run = serial if sum(sizes) <= _CHUNK else parallel
    where = np.array(addresses, np.int64).reshape(-1, 4)
    from_zero = np.array([step.from_zero for step in steps], np.bool_)
    run(_update_chunks, where, np.array(sizes, np.int64), numbers, from_zero)

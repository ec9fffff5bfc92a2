"""Adam's update of one float32 tensor in a single pass over memory (Numba, CPU)."""

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from crossgrad_core.optimizer.adam import LARGEST, SMALLEST_NORMAL, TINY, Coefficients

_CHUNK = 1 << 16  # elements; fixed, so that the split does not depend on the number of threads

_ZERO = np.float32(0)
_TINY, _SMALLEST_NORMAL, _LARGEST = (np.float32(v) for v in (TINY, SMALLEST_NORMAL, LARGEST))

_OPTIONS = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": {"contract", "nsz"}}


@njit(**_OPTIONS)
def _update(param, grad, exp_avg, exp_avg_sq, coefficients):
    beta1, new1, beta2, new2, step_size, root_scale, eps, square_floor = coefficients
    for i in range(len(param)):
        g = grad[i]
        g = _LARGEST if g > _LARGEST else (-_LARGEST if g < -_LARGEST else g)
        g = _ZERO if abs(g) < _TINY else g
        m = beta1 * exp_avg[i] + new1 * g
        m = _ZERO if abs(m) < _TINY else m
        g = _ZERO if abs(g) < square_floor else g
        v = beta2 * exp_avg_sq[i] + new2 * g * g
        v = _ZERO if v < _SMALLEST_NORMAL else v
        exp_avg[i] = m
        exp_avg_sq[i] = v
        param[i] -= step_size * (m / (np.sqrt(v) * root_scale + eps))


@njit(parallel=True, **_OPTIONS)
def _update_chunks(param, grad, exp_avg, exp_avg_sq, coefficients):
    for chunk in prange((len(param) + _CHUNK - 1) // _CHUNK):
        a, b = chunk * _CHUNK, min(len(param), (chunk + 1) * _CHUNK)
        _update(param[a:b], grad[a:b], exp_avg[a:b], exp_avg_sq[a:b], coefficients)


def update_arrays(
    param: NDArray[np.float32],
    grad: NDArray[np.float32],
    exp_avg: NDArray[np.float32],
    exp_avg_sq: NDArray[np.float32],
    step: Coefficients,
) -> None:
    """Applies one step in place on `param`, `exp_avg` and `exp_avg_sq`; all 1-D of one length."""
    coefficients = tuple(
        np.float32(value)
        for value in (
            step.beta1,
            1 - step.beta1,
            step.beta2,
            1 - step.beta2,
            step.step_size,
            step.root_scale,
            step.eps,
            step.square_floor,
        )
    )
    # A single chunk is not worth waking other threads for.
    update = _update if len(param) <= _CHUNK else _update_chunks
    update(param, grad, exp_avg, exp_avg_sq, coefficients)

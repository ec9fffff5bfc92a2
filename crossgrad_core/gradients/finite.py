"""Whether tensors are finite, and whether anything is in them, in one pass over each."""

from collections.abc import Sequence
from math import inf, isfinite
from typing import Final

import numpy as np
import torch
from torch import Tensor

from crossgrad_core.gradients.columns import is_native
from crossgrad_core.gradients.sparse_rows import values_of

_INFINITY: Final = int(np.float32(np.inf).view(np.uint32))
#: Parts for so few of which no other thread is woken.
_FEW: Final = 8


def largest(tensor: Tensor) -> Tensor:
    """The largest magnitude, a scalar on the tensor's device; NaN where an element is."""
    if not tensor.numel():
        return tensor.new_zeros(())
    size: Tensor = torch.linalg.vector_norm(tensor, inf)
    return size


def is_finite(tensor: Tensor) -> bool:
    """Whether no element is NaN or infinite."""
    return finite_and_present(tensor)[0]


def finite_and_present(tensor: Tensor | None) -> tuple[bool, bool]:
    """Whether no element is NaN or infinite, and whether one is not 0; (True, False) for None."""
    return all_finite_and_present([tensor])[0]


def all_finite_and_present(tensors: Sequence[Tensor | None]) -> list[tuple[bool, bool]]:
    """`finite_and_present` of each tensor, in one call for those of the CPU that need no copy."""
    given = [None if t is None else _elements(t) for t in tensors]
    native = [t for t in given if t is not None and _is_native(t)]
    bits = iter(_largest_bits(native))
    found = []
    for tensor in given:
        if tensor is None:
            found.append((True, False))
        elif _is_native(tensor):
            most = next(bits)
            found.append((most < _INFINITY, most > 0))
        elif not tensor.is_cpu and tensor.is_floating_point():
            value = float(largest(tensor))  # One pass, waited for once.
            found.append((isfinite(value), value > 0.0))
        else:
            found.append((bool(torch.isfinite(tensor).all()), bool(tensor.any())))
    return found


def _elements(tensor: Tensor) -> Tensor:
    return values_of(tensor.detach()) if tensor.is_sparse else tensor.detach()


def _is_native(tensor: Tensor) -> bool:
    return is_native([tensor]) and tensor.is_contiguous()


def _largest_bits(tensors: Sequence[Tensor]) -> list[int]:
    """The bits of the largest magnitude in each tensor, float32 on the CPU and contiguous."""
    if not tensors:
        return []
    from crossgrad_core.gradients.numba_kernels.largest import PART, largest_bits
    from crossgrad_core.numerics.jobs import parallel, serial

    sizes = np.array([tensor.numel() for tensor in tensors], np.int64)
    # A tensor without elements has a part, too.
    starts = np.array([0, *np.maximum(1, -(-sizes // PART)).cumsum()], np.int64)
    found = np.empty(starts[-1], np.uint32)
    call = parallel if len(found) > _FEW else serial
    call(largest_bits, np.array([t.data_ptr() for t in tensors], np.int64), sizes, starts, found)
    most: list[int] = np.maximum.reduceat(found, starts[:-1]).tolist()
    return most

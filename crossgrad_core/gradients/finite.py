"""Check tensors for non-finite and non-zero elements, in one pass over each tensor."""

from collections.abc import Sequence
from math import inf, isfinite
from typing import Final

import numpy as np
import torch
from torch import Tensor

from crossgrad_core.gradients.columns import is_native
from crossgrad_core.gradients.sparse_rows import values_of

_INFINITY: Final = int(np.float32(np.inf).view(np.uint32))
#: Up to this number of parts, a single thread checks all parts.
_FEW: Final = 8


def largest(tensor: Tensor) -> Tensor:
    """Return the largest magnitude as a scalar tensor. The result is NaN if an element is NaN."""
    if not tensor.numel():
        return tensor.new_zeros(())
    size: Tensor = torch.linalg.vector_norm(tensor, inf)
    return size


def is_finite(tensor: Tensor) -> bool:
    """Return True if no element is NaN or infinite."""
    return finite_and_present(tensor)[0]


def finite_and_present(tensor: Tensor | None) -> tuple[bool, bool]:
    """Return whether all elements are finite, and whether any element is not 0.

    For None instead of a tensor, return (True, False).
    """
    return all_finite_and_present([tensor])[0]


def all_finite_and_present(tensors: Sequence[Tensor | None]) -> list[tuple[bool, bool]]:
    """Return `finite_and_present` of each tensor.

    All contiguous float32 tensors on the CPU share one kernel call.
    """
    given = [None if t is None else _elements(t) for t in tensors]
    native = [t for t in given if t is not None and _is_native(t)]
    bits = iter(_largest_bits(native))
    results = []
    for tensor in given:
        if tensor is None:
            results.append((True, False))
        elif _is_native(tensor):
            most = next(bits)
            results.append((most < _INFINITY, most > 0))
        elif not tensor.is_cpu and tensor.is_floating_point():
            # `largest` reads the tensor only once and waits for the GPU only once.
            value = float(largest(tensor))
            results.append((isfinite(value), value > 0.0))
        else:
            results.append((bool(torch.isfinite(tensor).all()), bool(tensor.any())))
    return results


def _elements(tensor: Tensor) -> Tensor:
    return values_of(tensor.detach()) if tensor.is_sparse else tensor.detach()


def _is_native(tensor: Tensor) -> bool:
    return is_native([tensor]) and tensor.is_contiguous()


def _largest_bits(tensors: Sequence[Tensor]) -> list[int]:
    """Return the bits of the largest magnitude in each contiguous float32 tensor on the CPU."""
    if not tensors:
        return []
    from crossgrad_core.gradients.numba_kernels.largest import PART, largest_bits
    from crossgrad_core.numerics.jobs import parallel, serial

    sizes = np.array([tensor.numel() for tensor in tensors], np.int64)
    # An empty tensor also gets one part, so that `reduceat` returns a number for each tensor.
    starts = np.array([0, *np.maximum(1, -(-sizes // PART)).cumsum()], np.int64)
    largest_of_parts = np.empty(starts[-1], np.uint32)
    call = parallel if len(largest_of_parts) > _FEW else serial
    call(
        largest_bits,
        np.array([t.data_ptr() for t in tensors], np.int64),
        sizes,
        starts,
        largest_of_parts,
    )
    most: list[int] = np.maximum.reduceat(largest_of_parts, starts[:-1]).tolist()
    return most

"""Whether tensors are finite, and whether anything is in them, in one pass over each."""

from math import inf, isfinite
from typing import Final

import numpy as np
import torch
from torch import Tensor

from crossgrad_core.gradients.by_rows import values_of

_INFINITY: Final = int(np.float32(np.inf).view(np.uint32))
#: Elements that a thread looks at in one go; to wake others for a few such parts takes longer.
_PART: Final = 2**15
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
    if tensor is None:
        return True, False
    tensor = values_of(tensor.detach()) if tensor.is_sparse else tensor.detach()
    if not tensor.is_cpu and tensor.is_floating_point():
        value = float(largest(tensor))  # One pass, waited for once.
        return isfinite(value), value > 0.0
    if tensor.dtype != torch.float32 or not tensor.is_cpu or not tensor.is_contiguous():
        return bool(torch.isfinite(tensor).all()), bool(tensor.any())
    from crossgrad_core.gradients.numba_kernels.largest import largest_bits
    from crossgrad_core.numerics.jobs import alone, share

    found = np.empty(1 + tensor.numel() // _PART, np.uint32)
    call = share if len(found) > _FEW else alone
    call(largest_bits, tensor.view(-1).numpy().view(np.uint32), found)
    bits = int(found.max())
    return bits < _INFINITY, bits > 0

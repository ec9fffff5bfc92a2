"""Whether tensors are finite, and whether anything is in them, in one pass over each."""

from typing import Final

import numpy as np
import torch
from torch import Tensor

_INFINITY: Final = int(np.float32(np.inf).view(np.uint32))


def is_finite(tensor: Tensor) -> bool:
    """Whether no element is NaN or infinite."""
    return finite_and_present(tensor)[0]


def finite_and_present(tensor: Tensor | None) -> tuple[bool, bool]:
    """Whether no element is NaN or infinite, and whether one is not 0; (True, False) for None."""
    if tensor is None:
        return True, False
    tensor = tensor.detach()
    if tensor.dtype != torch.float32 or not tensor.is_cpu or not tensor.is_contiguous():
        return bool(torch.isfinite(tensor).all()), bool(tensor.any())
    from crossgrad_core.gradients.numba_kernels.largest import largest_bits

    largest = int(largest_bits(tensor.view(-1).numpy().view(np.uint32)))
    return largest < _INFINITY, largest > 0

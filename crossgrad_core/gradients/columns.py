"""Columns of gradients: float32 on the CPU uses compiled passes, everything else uses torch.

A *column* is the list of the K gradients of one tensor; None if a view does not touch the tensor.
"""

from collections.abc import Sequence
from typing import TypeAlias

import torch
from torch import Tensor

Column: TypeAlias = Sequence[Tensor | None]


def is_native(column: Column) -> bool:
    """Return True if the compiled passes support the column."""
    for gradient in column:
        if gradient is not None and (gradient.dtype != torch.float32 or not gradient.is_cpu):
            return False
    return True


def unit_roundoff(columns: Sequence[Column]) -> float:
    """Return the smallest unit roundoff of the gradients' types; 2^-24 without gradients."""
    types = {gradient.dtype for column in columns for gradient in column if gradient is not None}
    return min(torch.finfo(kind).eps / 2 for kind in types or {torch.float32})

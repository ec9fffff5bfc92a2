"""Columns of gradients: compiled kernels process float32 on the CPU, torch all other gradients.

A *column* is the list of the K views' gradients of one tensor. An entry is None if the view does
not touch the tensor.
"""

from collections.abc import Sequence
from typing import TypeAlias

import torch
from torch import Tensor

Column: TypeAlias = Sequence[Tensor | None]


def is_native(column: Column) -> bool:
    """Return True if the compiled kernels support all gradients of the column."""
    for gradient in column:
        if gradient is not None and (gradient.dtype != torch.float32 or not gradient.is_cpu):
            return False
    return True


def unit_roundoff(columns: Sequence[Column]) -> float:
    """Return the smallest unit roundoff of the gradients' types.

    Without gradients, return 2^-24 (float32).
    """
    types = {gradient.dtype for column in columns for gradient in column if gradient is not None}
    return min(torch.finfo(kind).eps / 2 for kind in types or {torch.float32})

"""Passes over the gradients of K views: compiled for float32 on the CPU, torch for the rest.

A *column* is the list of the K gradients of one tensor, None where a view does not touch it.
"""

from collections.abc import Sequence
from typing import TypeAlias

import torch
from torch import Tensor

Column: TypeAlias = Sequence[Tensor | None]


def is_native(column: Column) -> bool:
    """Whether the compiled passes take the column."""
    for gradient in column:
        if gradient is not None and (gradient.dtype != torch.float32 or not gradient.is_cpu):
            return False
    return True


def unit_roundoff(columns: Sequence[Column]) -> float:
    """The smallest unit roundoff of the gradients' types, 2^-24 for float32 ones or none at all."""
    types = {gradient.dtype for column in columns for gradient in column if gradient is not None}
    return min(torch.finfo(kind).eps / 2 for kind in types or {torch.float32})

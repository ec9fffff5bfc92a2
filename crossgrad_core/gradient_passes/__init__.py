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
    return all(g is None or (g.dtype == torch.float32 and g.device.type == "cpu") for g in column)

"""Plain sums of any mixture of columns, each by the pass that takes it."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from crossgrad_core.gradients import native
from crossgrad_core.gradients.columns import Column, is_native
from crossgrad_core.gradients.sparse_rows import PackedRows


def plain_sums(columns: Sequence[Column], divisor: int, *, keep: bool) -> list[Tensor | None]:
    """Adds each column's gradients in order and in their own type, then divides.

    Args:
        columns: T columns of contiguous gradients, dense or by rows; a None is left out.
        divisor: What the sums are divided by.
        keep: Leaves the gradients as they are; else the first of each column holds the result.

    Returns:
        T sums, None for columns without a gradient.
    """
    packed = [PackedRows(column) for column in columns]
    sums = _plain_sums([each.column for each in packed], divisor, keep=keep)
    return [each.unpacked(result) for each, result in zip(packed, sums, strict=True)]


def _plain_sums(columns: Sequence[Column], divisor: int, *, keep: bool) -> list[Tensor | None]:
    """The sums of dense columns."""
    sums: list[Tensor | None] = []
    compiled: list[Column] = []
    into: list[Tensor] = []
    for column in columns:
        given = [g for g in column if g is not None]
        if not given or (len(given) == 1 and divisor == 1):
            sums.append(given[0] if given else None)
            continue
        out = torch.empty_like(given[0]) if keep else given[0]
        sums.append(out)
        if is_native(column):
            compiled.append(column)
            into.append(out)
        else:
            _add_into(out, given, divisor)
    if compiled:
        weights = np.ones((len(compiled), len(compiled[0])))
        native.combine(compiled, weights, np.ones(len(compiled), np.bool_), into, divisor)
    return sums


def _add_into(out: Tensor, column: Sequence[Tensor], divisor: int) -> None:
    if out is not column[0]:
        out.copy_(column[0])
    for gradient in column[1:]:
        out.add_(gradient)
    if divisor != 1:
        out.div_(divisor)

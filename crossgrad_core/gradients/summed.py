"""The running sum of the gradients of K views, for operators that use only this sum."""

from collections.abc import Mapping, Sequence
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from typing_extensions import override

from crossgrad_core.contract.blocks import Block
from crossgrad_core.contract.gradients import Gradients
from crossgrad_core.gradients import native
from crossgrad_core.gradients.columns import Column, is_native
from crossgrad_core.gradients.finite import all_finite_and_present
from crossgrad_core.gradients.sparse_rows import PackedRows


def plain_sums(columns: Sequence[Column], divisor: int, *, keep: bool) -> list[Tensor | None]:
    """Add the gradients of each column in their own type, in the order of the views.

    After the addition, divide the sums by `divisor`.

    Args:
        columns: T columns of contiguous gradients, dense or sparse in rows; None is left out.
        divisor: Number by which the sums are divided.
        keep: True to leave the gradients unchanged. If `keep` is False, each result overwrites the
            first gradient of its column.

    Returns:
        T sums; None for a column without gradients.
    """
    packed = [PackedRows(column) for column in columns]
    sums = _plain_sums([packed_column.column for packed_column in packed], divisor, keep=keep)
    return [
        packed_column.unpacked(result) for packed_column, result in zip(packed, sums, strict=True)
    ]


def _plain_sums(columns: Sequence[Column], divisor: int, *, keep: bool) -> list[Tensor | None]:
    """Return the sums of dense columns."""
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


class SummedGradients(Gradients):
    """The sum of the gradients of K views, added in the order of the views.

    Gradients of single views are not stored.

    The constructor receives a complete sum, for example from the backward pass of a joint loss.
    `empty` and `add` build a sum view by view. If a view's gradient of a block is not finite, `add`
    leaves out the view for this block. `total` adds the last view and divides the sum in a single
    pass over memory.

    Args:
        total: Sum for each tensor, by name; None or a missing name if no view touches the tensor.
        blocks: The blocks of the backbone.
        views: Number of views K in `total`.
    """

    def __init__(
        self, total: Mapping[str, Tensor | None], blocks: Sequence[Block], views: int
    ) -> None:
        self._blocks = tuple(blocks)
        self._sum = {n: _contiguous(total.get(n)) for block in blocks for n in block.tensors}
        self._last: dict[str, Tensor] = {}
        self._divisor = 0
        self._views = self._expected = views
        #: Gradients that were checked, with the version counter of each tensor at the time of the
        #: check.
        self._looked: dict[str, tuple[Tensor, int]] = {}
        self._finite: list[NDArray[np.bool_]] = []
        self._present: list[NDArray[np.bool_]] = []
        if views:
            finite, present = self._judged(self._sum)
            self._finite, self._present = [finite] * views, [present] * views
            self._forget(finite)
            self._remember()

    @classmethod
    def empty(cls, blocks: Sequence[Block], views: int) -> Self:
        """Return a sum that contains no view yet and expects `views` views."""
        gradients = cls({}, blocks, 0)
        gradients._expected = views
        return gradients

    def add(self, view: Mapping[str, Tensor | None]) -> None:
        """Add the gradients of one more view.

        The caller must not use these gradients any more, because `add` and `total` overwrite them.

        Raises:
            RuntimeError: All expected views have already been added.
        """
        if self._views == self._expected:
            raise RuntimeError(
                f"more views were rendered than the {self._expected} views that were announced"
            )
        finite, present = self._judged(view)
        self._views += 1
        self._finite.append(finite)
        self._present.append(present)
        for block, kept in zip(self._blocks, finite, strict=True):
            for name in block.tensors if kept else ():
                gradient = _contiguous(view.get(name))
                if gradient is not None:
                    self._last[name] = gradient
        if self._views < self._expected:
            self._fold(1)

    @property
    @override
    def views(self) -> int:
        return self._views

    @override
    def total(self, divisor: int = 1) -> Mapping[str, Tensor | None]:
        """Return the sum for each tensor, divided by `divisor` (see `Gradients.total`).

        Raises:
            RuntimeError: The sum has already been divided by another number.
        """
        if self._divisor in {0, divisor}:
            if not self._divisor:
                alone = self._views == 1
                self._fold(divisor)
                if alone:
                    self._remember()
            self._divisor = divisor
            return self._sum
        if self._divisor != 1:
            raise RuntimeError(
                "the sum of the views' gradients is no longer available: their mean has "
                "overwritten it"
            )
        columns = [[gradient] for gradient in self._sum.values()]
        return dict(zip(self._sum, plain_sums(columns, divisor, keep=True), strict=True))

    @override
    def finite(self) -> NDArray[np.bool_]:
        return np.stack(self._finite, axis=1)

    @override
    def present(self) -> NDArray[np.bool_]:
        return np.stack(self._present, axis=1)

    @override
    def is_judged(self, name: str, gradient: Tensor) -> bool:
        judged_tensor, version = self._looked.get(name, (None, 0))
        return gradient is judged_tensor and gradient._version == version  # noqa: SLF001

    def _remember(self) -> None:
        """Record that the sum was checked.

        Record this only for a single view, because a sum of several views may overflow.
        """
        self._looked = {
            name: (gradient, gradient._version)  # noqa: SLF001
            for name, gradient in self._sum.items()
            if gradient is not None
        }

    def _judged(
        self, view: Mapping[str, Tensor | None]
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return two arrays [B] over blocks: finite gradients, and finite non-zero gradients."""
        names = [name for block in self._blocks for name in block.tensors]
        flags = all_finite_and_present([view.get(name) for name in names])
        flags_by_name = dict(zip(names, flags, strict=True))
        looks = [[flags_by_name[name] for name in block.tensors] for block in self._blocks]
        finite = np.array([all(is_finite for is_finite, _ in block) for block in looks], np.bool_)
        present = np.array(
            [any(is_present for _, is_present in block) for block in looks], np.bool_
        )
        return finite, finite & present

    def _fold(self, divisor: int) -> None:
        """Add the gradients of the last view to the sum, and divide the sum by `divisor`."""
        columns = [[gradient, self._last.get(name)] for name, gradient in self._sum.items()]
        sums = plain_sums(columns, divisor, keep=False)
        self._sum = dict(zip(self._sum, sums, strict=True))
        self._last = {}

    def _forget(self, finite: NDArray[np.bool_]) -> None:
        for block, kept in zip(self._blocks, finite, strict=True):
            if not kept:
                self._sum |= dict.fromkeys(block.tensors)


def _contiguous(gradient: Tensor | None) -> Tensor | None:
    if gradient is None:
        return None
    return gradient.detach() if gradient.is_sparse else gradient.detach().contiguous()

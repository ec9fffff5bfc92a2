"""Separate gradients of K views: each view has its own gradient of each parameter tensor."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from typing_extensions import override

from crossgrad_core.contract.blocks import Block
from crossgrad_core.contract.gradients import Elementwise, Granularity, SeparateGradients
from crossgrad_core.gradients import generic, native
from crossgrad_core.gradients import passes as exact
from crossgrad_core.gradients.columns import Column, is_native, unit_roundoff
from crossgrad_core.gradients.passes import column_gramians, column_remainders, passes_of
from crossgrad_core.gradients.sparse_rows import PackedRows, dense

KINDS: Final = ("geometry", "appearance", "neutral")


@dataclass(frozen=True)
class Groups:
    """The assignment of tensors to Gramians for one granularity.

    Attributes:
        names: [B] name of the block or group that each Gramian belongs to.
        of_tensor: [T] index of the Gramian to which each tensor belongs.
    """

    names: tuple[str, ...]
    of_tensor: NDArray[np.int64]


class DenseGradients(SeparateGradients):
    """The gradients of K views; each view has its own gradient of each parameter tensor.

    Sparse gradients stay sparse for sums and for the Gramians of blocks. All other operations
    convert sparse gradients to dense tensors. Gramians are computed in float64. `column_gramians`
    describes how very large and very small gradients are processed.

    Args:
        views: For each view: tensor name -> gradient. None or a missing name means that the view
            does not touch the tensor.
        blocks: The blocks of the backbone, in the order of the first dimension of Gramians.
        overwrite: True if `combine` and `total` may write their results into the gradients of one
            view. Overwritten gradients save memory, but can be used only once.
    """

    def __init__(
        self,
        views: Sequence[Mapping[str, Tensor | None]],
        blocks: Sequence[Block],
        *,
        overwrite: bool = False,
    ) -> None:
        self._blocks = tuple(blocks)
        self._views = len(views)
        self._overwrite = overwrite
        self._spent = False
        self._known: dict[Granularity, NDArray[np.float64]] = {}
        self._lost: dict[Granularity, NDArray[np.float64]] = {}
        self._tensors = tuple(name for block in self._blocks for name in block.tensors)
        self._packed = tuple(
            PackedRows([_prepared(view.get(name)) for view in views]) for name in self._tensors
        )
        self._columns: tuple[Column, ...] = tuple(packed.column for packed in self._packed)
        self._native = tuple(is_native(column) for column in self._columns)
        self._grouped: dict[Granularity, Groups] = {}

    @property
    @override
    def views(self) -> int:
        return self._views

    @override
    def names(self, granularity: Granularity) -> tuple[str, ...]:
        if granularity == "gaussian":
            names: tuple[str, ...] = ()
            for block, rows in zip(self._blocks, self._rows, strict=True):
                names += (block.name,) * rows
            return names
        return self._groups(granularity).names

    @override
    def gramians(self, granularity: Granularity) -> NDArray[np.float64]:
        raw = self._raw(granularity)
        finite = _finite(raw)
        if finite.all():
            return raw.copy()
        return np.where(finite[:, :, None] & finite[:, None, :], raw, 0.0)

    @property
    @override
    def unit(self) -> float:
        return unit_roundoff(self._columns)

    @override
    def rounding_residuals(self, granularity: Granularity) -> NDArray[np.float64]:
        if granularity not in self._lost:
            self._require_unspent()
            # A Gramian that is infinite or NaN is not used, so its residual is replaced by 0.
            residuals = np.nan_to_num(self._remainders(granularity), posinf=0.0, neginf=0.0)
            self._lost[granularity] = residuals
        return self._lost[granularity]

    @override
    def present(self, granularity: Granularity = "block") -> NDArray[np.bool_]:
        squares = _diagonal(self._raw(granularity))
        present: NDArray[np.bool_] = np.isfinite(squares) & (squares > 0)
        return present

    @override
    def finite(self, granularity: Granularity = "block") -> NDArray[np.bool_]:
        return _finite(self._raw(granularity))

    @override
    def overlap(self, granularity: Granularity) -> NDArray[np.bool_]:
        gramians, present = self.gramians(granularity), self.present(granularity)
        # Gradients with a non-zero dot product share a non-zero element. Only pairs with a zero dot
        # product need a check.
        shared: NDArray[np.bool_] = gramians != 0
        doubtful = ~shared & present[:, :, None] & present[:, None, :]
        for i, j in np.argwhere(np.triu(doubtful.any(axis=0), 1)).tolist():
            overlapping = self._overlap(granularity, i, j, doubtful[:, i, j])
            shared[:, i, j] |= overlapping
            shared[:, j, i] = shared[:, i, j]
        return shared

    @override
    def combine(
        self, weights: NDArray[np.float64], granularity: Granularity
    ) -> Mapping[str, Tensor | None]:
        weights = np.where(self.finite(granularity), weights, 0.0)
        if granularity == "gaussian":
            return self._combine_rows(weights)
        groups = self._groups(granularity)
        finite = self.finite(granularity)[groups.of_tensor]
        return self._combine(weights[groups.of_tensor], finite)

    @override
    def total(self, divisor: int = 1) -> Mapping[str, Tensor | None]:
        finite = self.finite("block")
        of_tensor = self._groups("block").of_tensor
        return self._combine(finite.astype(np.float64)[of_tensor], finite[of_tensor], divisor)

    @override
    def elementwise(self, function: Elementwise) -> Mapping[str, Tensor | None]:
        finite = self.finite("block")[self._groups("block").of_tensor]
        self._require_unspent()
        self._unpack()
        return {
            name: function(name, _selected(column, keep))
            for name, column, keep in zip(self._tensors, self._columns, finite, strict=True)
        }

    @cached_property
    def _rows(self) -> tuple[int, ...]:
        """Number of Gramians of each block for granularity `gaussian`.

        With this granularity, each primitive has its own Gramian.
        """
        self._unpack()
        shapes = {
            name: next((g.shape for g in column if g is not None), None)
            for name, column in zip(self._tensors, self._columns, strict=True)
        }
        counts = []
        for block in self._blocks:
            rows = [int(s[0]) for name in block.tensors if (s := shapes[name]) is not None and s]
            counts.append(rows[0] if block.per_primitive and rows else 1)
        return tuple(counts)

    @cached_property
    def _squares(self) -> NDArray[np.float64]:
        """Gramians [T, K, K] of the tensors.

        Entries of a view with a non-finite gradient are NaN or infinite.
        """
        self._require_unspent()
        columns = [[] if p.rows is not None else p.column for p in self._packed]
        squares = column_gramians(columns, self._views)
        for t, packed in enumerate(self._packed):
            if packed.rows is not None:
                squares[t] = native.spread_gramian(packed.column, packed.rows, packed.shape[0])
        return squares

    def _unpack(self) -> None:
        """Convert all gradients to dense tensors."""
        if any(packed.rows is not None for packed in self._packed):
            self._packed = tuple(
                PackedRows([dense(p.unpacked(g)) for g in p.column]) for p in self._packed
            )
            self._columns = tuple(packed.column for packed in self._packed)

    def _groups(self, granularity: Granularity) -> Groups:
        if granularity not in self._grouped:
            self._grouped[granularity] = self._grouping(granularity)
        return self._grouped[granularity]

    def _grouping(self, granularity: Granularity) -> Groups:
        counts = [len(block.tensors) for block in self._blocks]
        if granularity == "block":
            places = np.arange(len(self._blocks))
            return Groups(tuple(block.name for block in self._blocks), np.repeat(places, counts))
        if granularity == "global":
            return Groups(("all",), np.zeros(len(self._tensors), np.int64))
        kinds = tuple(kind for kind in KINDS if any(b.kind == kind for b in self._blocks))
        places = np.array([kinds.index(block.kind) for block in self._blocks], np.int64)
        return Groups(kinds, np.repeat(places, counts))

    def _raw(self, granularity: Granularity) -> NDArray[np.float64]:
        """Return [B, K, K] Gramians, which are computed only once.

        Entries of a view with a non-finite gradient are NaN or infinite.
        """
        if granularity not in self._known:
            self._known[granularity] = self._gathered(granularity)
        return self._known[granularity]

    def _gathered(self, granularity: Granularity) -> NDArray[np.float64]:
        if granularity == "gaussian":
            return self._row_squares()
        groups = self._groups(granularity)
        if len(groups.names) == len(self._tensors) and granularity == "block":
            return self._squares
        raw = np.zeros((len(groups.names), self._views, self._views))
        # The sum of infinity and minus infinity is NaN, which is intended here.
        with np.errstate(invalid="ignore"):
            np.add.at(raw, groups.of_tensor, self._squares)
        return raw

    def _row_squares(self) -> NDArray[np.float64]:
        self._require_unspent()
        parts = []
        for block, columns, rows in self._by_block():
            touched = [c for c in columns if any(g is not None for g in c)]
            passes = passes_of(*touched)
            if touched and block.per_primitive:
                parts.append(passes.row_gramians(touched, rows))
            else:
                places = [self._tensors.index(name) for name in block.tensors]
                parts.append(self._squares[places].sum(axis=0)[None])
        return np.concatenate(parts) if parts else np.zeros((0, self._views, self._views))

    def _remainders(self, granularity: Granularity) -> NDArray[np.float64]:
        self._unpack()
        raw = self._raw(granularity)
        if granularity != "gaussian":
            return column_remainders(self._columns, self._groups(granularity).of_tensor, raw)
        parts, first = [np.zeros((0, self._views, self._views))], 0
        for block, columns, rows in self._by_block():
            block_gramians = raw[first : first + rows]
            first += rows
            if block.per_primitive:
                parts.append(exact.row_remainders(columns, rows, block_gramians))
            else:
                group = np.array([0 if name in block.tensors else -1 for name in self._tensors])
                parts.append(column_remainders(self._columns, group, block_gramians))
        return np.concatenate(parts)

    def _by_block(self) -> Sequence[tuple[Block, Sequence[Column], int]]:
        result, first = [], 0
        for block, rows in zip(self._blocks, self._rows, strict=True):
            result.append((block, self._columns[first : first + len(block.tensors)], rows))
            first += len(block.tensors)
        return result

    def _overlap(
        self, granularity: Granularity, i: int, j: int, doubtful: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        self._require_unspent()
        if granularity == "gaussian":
            return self._row_overlap(i, j)
        overlapping = np.zeros_like(doubtful)
        for group, column in zip(self._groups(granularity).of_tensor, self._columns, strict=True):
            if doubtful[group] and not overlapping[group]:
                passes = passes_of(column)
                overlapping[group] = passes.overlap(column, i, j)
        return overlapping

    def _row_overlap(self, i: int, j: int) -> NDArray[np.bool_]:
        parts = []
        for block, columns, rows in self._by_block():
            shared = np.zeros(rows, np.bool_)
            for column in columns:
                passes = passes_of(column)
                if block.per_primitive:
                    passes.row_overlap(column, i, j, rows, shared)
                else:
                    shared |= passes.overlap(column, i, j)
            parts.append(shared)
        return np.concatenate(parts)

    def _combine(
        self, weights: NDArray[np.float64], finite: NDArray[np.bool_], divisor: int = 1
    ) -> dict[str, Tensor | None]:
        """Return the weighted sums for all tensors.

        The arrays `weights` and `finite` are [T, K].
        """
        results: dict[str, Tensor | None] = dict.fromkeys(self._tensors)
        used = weights != 0
        plain = ((weights == 1) | ~used).all(axis=1) & used.any(axis=1)
        order = self._order(weights, plain)
        compiled: list[int] = []
        chosen = list(self._columns)
        for t, (name, column) in enumerate(zip(self._tensors, self._columns, strict=True)):
            out = results[name] = self._result(column, finite[t])
            if out is None:
                continue
            chosen[t] = [column[k] if used[t, k] else None for k in order[t].tolist()]
            if self._native[t]:
                compiled.append(t)
            else:
                generic.combine(chosen[t], weights[t, order[t]], bool(plain[t]), out, divisor)
        if compiled:
            outs = [results[self._tensors[t]] for t in compiled]
            native.combine(
                [chosen[t] for t in compiled],
                np.take_along_axis(weights, order, axis=1)[compiled],
                plain[compiled],
                [out for out in outs if out is not None],
                divisor,
            )
        self._spent = self._overwrite
        return {n: p.unpacked(results[n]) for n, p in zip(results, self._packed, strict=True)}

    def _order(self, weights: NDArray[np.float64], plain: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Return [T, K], the order in which the views are added.

        Weighted sums begin with the largest summand; plain sums keep the order of the views.
        """
        order = np.tile(np.arange(self._views), (len(self._tensors), 1))
        # The order of two summands does not change the sum.
        if self._views > 2 and not plain.all():  # noqa: PLR2004
            squares = _diagonal(self._squares)
            norms = np.sqrt(np.where(np.isfinite(squares), squares, 0.0))
            sorting = ~plain
            order[sorting] = np.argsort(-np.abs(weights * norms)[sorting], axis=1, kind="stable")
        return order

    def _combine_rows(self, weights: NDArray[np.float64]) -> dict[str, Tensor | None]:
        results: dict[str, Tensor | None] = dict.fromkeys(self._tensors)
        first = 0
        for block, columns, rows in self._by_block():
            block_weights = weights[first : first + rows]
            first += rows
            for name, column in zip(block.tensors, columns, strict=True):
                out = self._result(column, np.ones(self._views, np.bool_))
                if out is None:
                    continue
                results[name] = out
                passes = passes_of(column)
                passes.row_combine(column, block_weights, out)
        self._spent = self._overwrite
        return results

    def _result(self, column: Column, finite: NDArray[np.bool_]) -> Tensor | None:
        """Return a tensor for the result.

        Return None if no view has a finite gradient of the parameter tensor.
        """
        self._require_unspent()
        first = next((g for g in _selected(column, finite) if g is not None), None)
        if first is None:
            return None
        return first if self._overwrite else torch.empty_like(first)

    def _require_unspent(self) -> None:
        if self._spent:
            raise RuntimeError(
                "the gradients of single views are no longer available: their sum has "
                "overwritten them"
            )


def _prepared(gradient: Tensor | None) -> Tensor | None:
    if gradient is None:
        return None
    return gradient.detach() if gradient.is_sparse else gradient.detach().contiguous()


def _selected(column: Column, keep: NDArray[np.bool_]) -> list[Tensor | None]:
    return [g if kept else None for g, kept in zip(column, keep, strict=True)]


def _diagonal(gramians: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.diagonal(gramians, axis1=1, axis2=2)


def _finite(gramians: NDArray[np.float64]) -> NDArray[np.bool_]:
    finite: NDArray[np.bool_] = np.isfinite(_diagonal(gramians))
    return finite

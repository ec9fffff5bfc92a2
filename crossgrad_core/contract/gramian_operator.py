"""Operators that use only the dot products of the gradients of K views."""

from abc import abstractmethod
from collections.abc import Sequence
from functools import partial
from typing import ClassVar, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from typing_extensions import override

from crossgrad_core.contract.blocks import Block, BlockKind, PluginState
from crossgrad_core.contract.component import answered, with_state
from crossgrad_core.contract.contexts import AggregateContext, AggregateResult, OperatorContext
from crossgrad_core.contract.gradients import Granularity, SeparateGradients
from crossgrad_core.contract.slots.operator import Operator
from crossgrad_core.errors import UserError

#: If the unit roundoff of the gradients is below this value, rounding errors of float64 weights
#: change the result.
_NARROW: Final = 1e-12


class MatrixOperator(Operator):
    """An operator that multiplies a block's K gradients G by a matrix M and adds the rows of M G.

    Such an operator can be used in a chain of operators and for single blocks.
    """

    sparse_rows: ClassVar[bool] = True

    @abstractmethod
    def transform(
        self,
        gramians: NDArray[np.float64],
        context: OperatorContext,
        state: PluginState,
        rng: np.random.Generator,
    ) -> tuple[NDArray[np.float64], PluginState]:
        """Return a matrix M for each block; M multiplies the K gradients of the block.

        Args:
            gramians: [B, K, K] float64, symmetric positive semi-definite up to rounding.
            context: See `OperatorContext`.
            state: The state that this operator returned last.
            rng: The only source of random numbers.

        Returns:
            [B, R, K] float64 matrices M (the operator chooses R) and the new state. A chain of
            operators multiplies the matrices: the next operator receives M Gram M^T.
        """

    @override
    def aggregate(
        self, context: AggregateContext, state: PluginState
    ) -> tuple[AggregateResult, PluginState]:
        return aggregate_by_gramians(self, "block", context, state)


class GramianOperator(MatrixOperator):
    """An operator whose matrices depend on the Gramians.

    Attributes:
        granularity: The extent of one Gramian: a block (`block`), all blocks of a kind (`kind`),
            all blocks (`global`), or one Gaussian's row of a block (`gaussian`).
    """

    sparse_rows: ClassVar[bool] = True

    granularity: Granularity = Field("block", description="tensors that one Gramian covers")

    def reads_gramians(self) -> bool:
        """Return True if the result depends on the Gramians; if not, granularity has no effect."""
        return True

    @override
    def aggregate(
        self, context: AggregateContext, state: PluginState
    ) -> tuple[AggregateResult, PluginState]:
        return aggregate_by_gramians(self, self.granularity, context, state)


class Weighting(GramianOperator):
    """A Gramian operator that gives each view one weight per block, without memory of past steps.

    In a chain, the next operator receives the K weighted gradients.
    """

    @abstractmethod
    def weights(
        self, gramians: NDArray[np.float64], context: OperatorContext
    ) -> NDArray[np.float64]:
        """Return [B, K] float64 weights of the K gradients; the result is their weighted sum.

        Args:
            gramians: [B, K, K] float64, symmetric positive semi-definite up to rounding.
            context: See `OperatorContext`.
        """

    @override
    def transform(
        self,
        gramians: NDArray[np.float64],
        context: OperatorContext,
        state: PluginState,
        rng: np.random.Generator,
    ) -> tuple[NDArray[np.float64], PluginState]:
        weights = answered(self.weights(gramians, context), np.ndarray, self, "weights")
        if weights.shape != gramians.shape[:2]:
            raise _misfit(self, gramians, weights)
        return diagonals(weights), state


def diagonals(weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return diagonal matrices [B, K, K] whose diagonals are the weights [B, K]."""
    blocks, views = weights.shape
    matrices = np.zeros((blocks, views, views))
    matrices.reshape(blocks, -1)[:, :: views + 1] = weights
    return matrices


def aggregate_by_gramians(
    operator: MatrixOperator,
    granularity: Granularity,
    context: AggregateContext,
    state: PluginState,
) -> tuple[AggregateResult, PluginState]:
    """Aggregate gradients with the matrices of an operator.

    The aggregation takes one pass for the Gramians of all blocks, one small solve, and one pass for
    the weighted sums.

    The result counts the Gramians in which an event occurred; with granularity `block`, each block
    has one Gramian. Event `zero`: a view has no gradient or a gradient of exactly zero. Event
    `disjoint`: two non-zero gradients have no common element. Event `dropped`: a view was left out
    because its gradient is not finite. Event `conflict`: two gradients have a negative dot product.

    Raises:
        UserError: The operator returned weights that are not finite.
    """
    gradients = context.separate
    gramians = gradients.gramians(granularity)
    present = gradients.present(granularity)
    given = operator_context(context, granularity, present)
    matrices, state = transformed(operator, gramians, given, state, context.rng)
    weights = np.where(present, _added_rows(matrices, gradients.unit), 0.0)
    if not np.isfinite(weights).all():
        raise _not_finite(operator, given, weights)
    # Compute the counts before the weighted sum, because the sum may overwrite gradients that the
    # counts still need.
    counts = _counts(gradients, granularity, gramians, present)
    return AggregateResult(gradients.combine(weights, granularity), counts), state


def transformed(
    operator: MatrixOperator,
    gramians: NDArray[np.float64],
    context: OperatorContext,
    state: PluginState,
    rng: np.random.Generator,
) -> tuple[NDArray[np.float64], PluginState]:
    """Return the checked result of an operator's `transform`.

    An operator that contains other operators calls the other operators through this function.

    Raises:
        UserError: The result has a wrong type or shape.
    """
    answer = operator.transform(gramians, context, state, rng)
    matrices, state = with_state(answer, np.ndarray, operator, "transform")
    if matrices.ndim != gramians.ndim or matrices.shape[::2] != gramians.shape[::2]:
        raise _misfit(operator, gramians, matrices)
    return matrices, state


def _added_rows(matrices: NDArray[np.float64], unit: float) -> NDArray[np.float64]:
    """Return [B, K], the sum over R of matrices [B, R, K].

    The sum is computed row by row, because NumPy is slow at sums over few rows. For gradients in
    float64, the rounding errors of the additions are compensated (Neumaier 1974).
    """
    total = np.zeros((matrices.shape[0], matrices.shape[2]))
    lost = np.zeros_like(total)
    for row in range(matrices.shape[1]):
        added = matrices[:, row]
        before, total = total, total + added
        if unit < _NARROW:
            larger = np.abs(before) >= np.abs(added)
            lost += np.where(larger, (before - total) + added, (added - total) + before)
    return total + lost if unit < _NARROW else total


def operator_context(
    context: AggregateContext, granularity: Granularity, present: NDArray[np.bool_]
) -> OperatorContext:
    """Return the context of a Gramian operator, made from the context of the hook."""
    names = context.separate.names(granularity)
    return OperatorContext(
        step=context.step,
        blocks=names,
        kinds=_kinds(names, context.blocks, granularity),
        losses=context.losses,
        labels=context.labels,
        distances=context.distances,
        reference_distance=context.reference_distance,
        present=present,
        unit=context.separate.unit,
        rounding_residuals=partial(context.separate.rounding_residuals, granularity),
        scales=context.scales,
    )


def _kinds(
    names: Sequence[str], blocks: Sequence[Block], granularity: Granularity
) -> tuple[BlockKind, ...]:
    """Return the kind of each block, or of each group of blocks.

    A group of blocks is named by its kind; the group `all` is neutral.
    """
    kind_by_name: dict[str, BlockKind] = {
        "geometry": "geometry",
        "appearance": "appearance",
        "neutral": "neutral",
        "all": "neutral",
    }
    # Use the names of the blocks as keys, because a block may have the same name as a group.
    if granularity in {"block", "gaussian"}:
        kind_by_name = {block.name: block.kind for block in blocks}
    return tuple(map(kind_by_name.__getitem__, names))


def _counts(
    gradients: SeparateGradients,
    granularity: Granularity,
    gramians: NDArray[np.float64],
    present: NDArray[np.bool_],
) -> dict[str, int]:
    finite = gradients.finite(granularity)
    pairs = present[:, :, None] & present[:, None, :]
    disjoint = 0
    if (pairs & (gramians == 0)).any():
        disjoint = _some(pairs & ~gradients.overlap(granularity))
    return {
        "zero": _some(finite & ~present),
        "disjoint": disjoint,
        "dropped": _some(~finite),
        "conflict": _some(gramians < 0),
    }


def _some(flags: NDArray[np.bool_]) -> int:
    """Return the number of blocks in which any flag is set."""
    return int(flags.reshape(len(flags), -1).any(axis=1).sum()) if flags.size else 0


def _misfit(
    operator: Operator, gramians: NDArray[np.float64], answer: NDArray[np.float64]
) -> UserError:
    blocks, views = gramians.shape[:2]
    return UserError(
        f"operator {type(operator).__name__} returned an array of a wrong shape",
        where=f"{blocks} blocks, {views} views",
        expected=f"[{blocks}, {views}] weights, or [{blocks}, R, {views}] matrices",
        found=f"{list(answer.shape)}",
        todo="repair the plugin, or choose another operator",
    )


def _not_finite(
    operator: Operator, context: OperatorContext, weights: NDArray[np.float64]
) -> UserError:
    block = context.blocks[int(np.argmax(~np.isfinite(weights).all(axis=1)))]
    return UserError(
        f"operator {type(operator).__name__} returned weights that are not finite",
        where=f"block {block}, step {context.step}",
        expected="finite weights for finite gradients",
        todo="use another operator, or report this to the operator's author",
    )

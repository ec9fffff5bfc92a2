"""Operators that see the gradients of K views through their dot products only."""

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

#: Gradients whose unit roundoff is below this show the rounding of float64 weights.
_NARROW: Final = 1e-12


class MatrixOperator(Operator):
    """Replaces the K gradients G of each block by M G and adds the rows of M G.

    It can be a link of a chain and serve single blocks.
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
        """The matrices M.

        Args:
            gramians: [B, K, K] float64, symmetric positive semi-definite up to rounding.
            context: See `OperatorContext`.
            state: What this operator returned last.
            rng: The only source of random numbers.

        Returns:
            [B, R, K] float64 matrices M (R is the operator's choice) and the new state. A chain of
            operators multiplies them: the next link sees M Gram M^T.
        """

    @override
    def aggregate(
        self, context: AggregateContext, state: PluginState
    ) -> tuple[AggregateResult, PluginState]:
        return aggregate_by_gramians(self, "block", context, state)


class GramianOperator(MatrixOperator):
    """An operator whose matrices depend on the Gramians.

    Attributes:
        granularity: What one Gramian covers: each block's tensors, all geometry / all appearance
            blocks, everything, or each Gaussian's row of a block.
    """

    sparse_rows: ClassVar[bool] = True

    granularity: Granularity = Field("block", description="what one Gramian covers")

    def reads_gramians(self) -> bool:
        """Whether the Gramians make a difference with these options; else granularity does not."""
        return True

    @override
    def aggregate(
        self, context: AggregateContext, state: PluginState
    ) -> tuple[AggregateResult, PluginState]:
        return aggregate_by_gramians(self, self.granularity, context, state)


class Weighting(GramianOperator):
    """A Gramian operator that gives each view one weight per block, from this step alone.

    In a chain the next link sees the K weighted gradients.
    """

    @abstractmethod
    def weights(
        self, gramians: NDArray[np.float64], context: OperatorContext
    ) -> NDArray[np.float64]:
        """[B, K] float64 weights of the K gradients; their weighted sum is the result.

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
    """[B, K, K] matrices that multiply each of K gradients by its weight; `weights` is [B, K]."""
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
    """One pass for the Gramians of all blocks, one small solve, one pass for the weighted sums.

    Counts blocks (Gramians, under other granularities) in which some view's gradient is exactly
    zero or absent (`zero`), some pair of non-zero gradients shares no element (`disjoint`), some
    view was left out because it is not finite (`dropped`), or some pair has a negative dot product
    (`conflict`).

    Raises:
        UserError: The operator answered with weights that are not finite.
    """
    gradients = context.separate
    gramians = gradients.gramians(granularity)
    present = gradients.present(granularity)
    given = operator_context(context, granularity, present)
    matrices, state = transformed(operator, gramians, given, state, context.rng)
    weights = np.where(present, _added_rows(matrices, gradients.unit), 0.0)
    if not np.isfinite(weights).all():
        raise _not_finite(operator, given, weights)
    # Before the sum, which may overwrite the gradients: two whose product is 0 are looked at again.
    counts = _counts(gradients, granularity, gramians, present)
    return AggregateResult(gradients.combine(weights, granularity), counts), state


def transformed(
    operator: MatrixOperator,
    gramians: NDArray[np.float64],
    context: OperatorContext,
    state: PluginState,
    rng: np.random.Generator,
) -> tuple[NDArray[np.float64], PluginState]:
    """What `transform` of an operator answers; operators that hold others ask these by it.

    Raises:
        UserError: The answer is none that has a meaning: it names the method.
    """
    answer = operator.transform(gramians, context, state, rng)
    matrices, state = with_state(answer, np.ndarray, operator, "transform")
    if matrices.ndim != gramians.ndim or matrices.shape[::2] != gramians.shape[::2]:
        raise _misfit(operator, gramians, matrices)
    return matrices, state


def _added_rows(matrices: NDArray[np.float64], unit: float) -> NDArray[np.float64]:
    """[B, K] the sum over R of matrices [B, R, K]; row by row, as numpy is slow at short sums.

    Weights for gradients in float64 are compensated for what each addition loses (Neumaier 1974).
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
    """What a Gramian operator may know, from what the hook is offered."""
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
    """Kinds of blocks; groups are named by their kind, the whole is neutral."""
    known: dict[str, BlockKind] = {
        "geometry": "geometry",
        "appearance": "appearance",
        "neutral": "neutral",
        "all": "neutral",
    }
    if granularity in {"block", "gaussian"}:  # A block may be called as a group is.
        known = {block.name: block.kind for block in blocks}
    return tuple(map(known.__getitem__, names))


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
    """In how many blocks any flag is set."""
    return int(flags.reshape(len(flags), -1).any(axis=1).sum()) if flags.size else 0


def _misfit(
    operator: Operator, gramians: NDArray[np.float64], found: NDArray[np.float64]
) -> UserError:
    blocks, views = gramians.shape[:2]
    return UserError(
        f"operator {type(operator).__name__} gave an array of a wrong shape",
        where=f"{blocks} blocks, {views} views",
        expected=f"[{blocks}, {views}] weights, or [{blocks}, R, {views}] matrices",
        found=f"{list(found.shape)}",
        todo="repair the plugin, or choose another operator",
    )


def _not_finite(
    operator: Operator, context: OperatorContext, weights: NDArray[np.float64]
) -> UserError:
    block = context.blocks[int(np.argmax(~np.isfinite(weights).all(axis=1)))]
    return UserError(
        f"operator {type(operator).__name__} gave weights that are not finite",
        where=f"block {block}, step {context.step}",
        expected="finite weights for finite gradients",
        todo="use another operator, or report this to the operator's author",
    )

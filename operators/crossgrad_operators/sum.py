"""The sum and the mean of the views' gradients."""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from crossgrad_core.plugin import (
    AggregateContext,
    AggregateResult,
    MatrixOperator,
    OperatorContext,
    PluginState,
)


class Sum(MatrixOperator):
    """u = sum of g_k: what one backward pass through the summed losses gives.

    Needs no Gramian and no separate gradients; both ways lead to the same bits.
    """

    separate: ClassVar[bool] = False
    identity_at_one: ClassVar[bool] = True
    sparse_rows: ClassVar[bool] = True

    @override
    def transform(
        self,
        gramians: NDArray[np.float64],
        context: OperatorContext,
        state: PluginState,
        rng: np.random.Generator,
    ) -> tuple[NDArray[np.float64], PluginState]:
        blocks, views, _ = gramians.shape
        return np.tile(np.eye(views), (blocks, 1, 1)), state

    @override
    def aggregate(
        self, context: AggregateContext, state: PluginState
    ) -> tuple[AggregateResult, PluginState]:
        return divided_sum(context, 1), state


def divided_sum(context: AggregateContext, divisor: int) -> AggregateResult:
    """The sum of the views' gradients over `divisor`, without Gramians.

    Counts blocks in which some view's gradient is exactly zero or absent (`zero`) or was left out
    because it is not finite (`dropped`).
    """
    gradients = context.gradients
    finite, present = gradients.finite(), gradients.present()
    counts = {
        "zero": int((finite & ~present).any(axis=1).sum()),
        "dropped": int((~finite).any(axis=1).sum()),
    }
    return AggregateResult(gradients.total(divisor), counts)


class Mean(MatrixOperator):
    """u = (1/K) sum of g_k; K counts all views of the step, also those without a gradient.

    Under Adam the same as `sum` up to the optimizer's eps. Needs no separate gradients.
    """

    separate: ClassVar[bool] = False
    identity_at_one: ClassVar[bool] = True
    sparse_rows: ClassVar[bool] = True

    @override
    def transform(
        self,
        gramians: NDArray[np.float64],
        context: OperatorContext,
        state: PluginState,
        rng: np.random.Generator,
    ) -> tuple[NDArray[np.float64], PluginState]:
        blocks, views, _ = gramians.shape
        return np.tile(np.eye(views) / views, (blocks, 1, 1)), state

    @override
    def aggregate(
        self, context: AggregateContext, state: PluginState
    ) -> tuple[AggregateResult, PluginState]:
        return divided_sum(context, context.gradients.views), state

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
    """u = sum of g_k, equal to one backward pass through the sum of the losses.

    No Gramian and no separate gradients are needed. Separate gradients give the same bits as
    accumulated gradients.
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
    """Return the sum of the views' gradients divided by `divisor`, without Gramians.

    The counts are numbers of blocks: `zero` counts blocks in which the gradient of a view is
    exactly zero or absent. `dropped` counts blocks in which the gradient of a view was left out
    because it is not finite.
    """
    gradients = context.gradients
    finite, present = gradients.finite(), gradients.present()
    counts = {
        "zero": int((finite & ~present).any(axis=1).sum()),
        "dropped": int((~finite).any(axis=1).sum()),
    }
    return AggregateResult(gradients.total(divisor), counts)


class Mean(MatrixOperator):
    """u = (1/K) sum of g_k, where K counts all views of the step, also views without a gradient.

    Under Adam it equals `sum` up to the optimizer's eps. No separate gradients are needed.
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

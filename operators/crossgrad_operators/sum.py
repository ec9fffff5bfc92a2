"""Operators that return the sum or the mean of the views' gradients."""

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
    """The sum of the gradients, equal to a backward pass through the sum of the losses.

    The operator needs neither Gramians nor separate gradients. If separate gradients are available,
    their sum is bit-identical to accumulated gradients.
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
    """Return the sum of the views' gradients, divided by `divisor`. No Gramians are computed.

    The counts are numbers of blocks. `zero` counts blocks in which the gradient of a view is zero
    or missing. `dropped` counts blocks in which the gradient of a view is not finite and was left
    out.
    """
    gradients = context.gradients
    finite, present = gradients.finite(), gradients.present()
    counts = {
        "zero": int((finite & ~present).any(axis=1).sum()),
        "dropped": int((~finite).any(axis=1).sum()),
    }
    return AggregateResult(gradients.total(divisor), counts)


class Mean(MatrixOperator):
    """The mean of the gradients. The divisor K also counts views without a gradient.

    With Adam, the result equals `sum`, except for the effect of eps. The operator does not need
    separate gradients.
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

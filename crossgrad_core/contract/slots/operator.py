"""The operator slot: a component combines the gradients of K views into one gradient per tensor."""

from abc import abstractmethod
from collections.abc import Mapping
from typing import ClassVar

from typing_extensions import override

from crossgrad_core.contract.blocks import PluginState
from crossgrad_core.contract.component import Component, ViewCounts, hookimpl, with_state
from crossgrad_core.contract.contexts import AggregateContext, AggregateResult

STATE = "operator"


class Operator(Component):
    """A method that combines the gradients of K views into one gradient per tensor.

    Most operators need only the K x K Gramians of the gradients: see `GramianOperator`.

    Attributes:
        separate: True if the operator needs the separate gradients of the views. Otherwise the
            backward passes accumulate one gradient, which is bitwise equal to the sum of the
            separate gradients and needs no copies.
        views: Supported values of K.
        identity_at_one: True if the operator returns the gradient of a single view unchanged. A run
            with one view per step then reports that the operator has no effect.
        default_grouping: Name of the grouping that is used if the user names none; None if the
            operator needs no labels.
        sparse_rows: True if `aggregate` returns the results of `total` and `combine` unchanged,
            sparse or dense. A subclass that overrides `aggregate` does not inherit this value and
            receives dense gradients, unless it declares the value itself.
    """

    slot: ClassVar[str] = "operators"
    separate: ClassVar[bool] = True
    views: ClassVar[ViewCounts] = ViewCounts()
    identity_at_one: ClassVar[bool] = False
    default_grouping: ClassVar[str | None] = None
    sparse_rows: ClassVar[bool] = False

    @classmethod
    @override
    def __pydantic_init_subclass__(cls, **kwargs: object) -> None:
        answers = {"aggregate", "crossgrad_aggregate_gradients"} & vars(cls).keys()
        if answers and "sparse_rows" not in vars(cls):
            cls.sparse_rows = False

    @property
    def resolved_grouping(self) -> str | None:
        """The grouping that the operator needs with its present options if the user names none."""
        return self.default_grouping

    def is_identity(self, views: int) -> bool:
        """Return True if the result for this number of views is always the plain sum."""
        return views == 1 and self.identity_at_one

    def needs_more_views(self, views: int) -> bool:
        """Return True if the operator, or an operator in it, has no effect with `views` views."""
        return self.is_identity(views)

    def reads_labels(self) -> bool:
        """Return True if the result of the operator depends on the labels of the views."""
        return False

    @abstractmethod
    def aggregate(
        self, context: AggregateContext, state: PluginState
    ) -> tuple[AggregateResult, PluginState]:
        """Return one gradient per tensor, and the new state.

        The result must not depend on the order of the views in the step. The result may depend only
        on labels, losses, distances and gradients. Views with equal labels, losses, distances and
        gradients must have equal weights.

        Args:
            context: The gradients of the K views and further data of the views.
            state: The state that this operator returned last.
        """

    @hookimpl
    def crossgrad_aggregate_gradients(self, context: AggregateContext) -> AggregateResult:
        """Return this operator's result for the hook."""
        answer = self.aggregate(context, context.state(STATE))
        aggregated, state = with_state(answer, AggregateResult, self, "aggregate")
        states: Mapping[str, PluginState] = {**aggregated.states, STATE: state}
        return AggregateResult(aggregated.gradients, aggregated.counts, states=states)

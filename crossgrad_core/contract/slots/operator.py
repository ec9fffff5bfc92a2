"""The operator slot: the gradients of K views -> one gradient per tensor."""

from abc import abstractmethod
from collections.abc import Mapping
from typing import ClassVar

from typing_extensions import override

from crossgrad_core.contract.blocks import PluginState
from crossgrad_core.contract.component import Component, ViewCounts, hookimpl, with_state
from crossgrad_core.contract.contexts import AggregateContext, AggregateResult

STATE = "operator"


class Operator(Component):
    """Turns the gradients of K views into one per tensor.

    Most operators need only the K x K Gramians of the gradients: see `GramianOperator`.

    Attributes:
        separate: Whether it needs the views' gradients apart. Where not, the backward passes
            accumulate into one gradient: same bits, no copies.
        views: For which K the operator has a meaning.
        identity_at_one: Whether it leaves the gradient of a single view as it is. A run with K = 1
            then reports that the operator does nothing.
        default_grouping: Name of the grouping it needs unless the user names another; None where
            it needs no labels.
        sparse_rows: Whether `aggregate` hands on what `total` and `combine` answer as it is, sparse
            or dense. It holds for the class that says so and for subclasses that keep its
            `aggregate`; other classes get dense gradients only.
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
        """The grouping it needs with its options as they are, where the user names none."""
        return self.default_grouping

    def is_identity(self, views: int) -> bool:
        """Whether the result is the plain sum, whatever the gradients of that many views are."""
        return views == 1 and self.identity_at_one

    def needs_more_views(self, views: int) -> bool:
        """Whether it, or an operator that it consists of, does nothing with so many views."""
        return self.is_identity(views)

    def reads_labels(self) -> bool:
        """Whether the labels of the views make a difference to it."""
        return False

    @abstractmethod
    def aggregate(
        self, context: AggregateContext, state: PluginState
    ) -> tuple[AggregateResult, PluginState]:
        """One gradient per tensor, and the new state.

        The place of a view in the step means nothing. Views are told apart by labels, losses,
        distances or gradients; views that differ in none of these count alike.

        Args:
            context: The gradients of the K views and what is known about them.
            state: What this operator returned last.
        """

    @hookimpl
    def crossgrad_aggregate_gradients(self, context: AggregateContext) -> AggregateResult:
        """Answers the hook with this operator's directions."""
        answer = self.aggregate(context, context.state(STATE))
        aggregated, state = with_state(answer, AggregateResult, self, "aggregate")
        states: Mapping[str, PluginState] = {**aggregated.states, STATE: state}
        return AggregateResult(aggregated.gradients, aggregated.counts, states=states)

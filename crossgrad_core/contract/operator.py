"""The operator slot: K per-view gradients of a block -> one update direction."""

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from typing_extensions import override

from crossgrad_core.contract.blocks import BlockKind
from crossgrad_core.contract.component import Component, Selection, ViewCounts
from crossgrad_core.contract.contexts import AggregateContext, Aggregated
from crossgrad_core.contract.hooks import hookimpl
from crossgrad_core.contract.state import PluginState

STATE = "operator"

Granularity = Literal["tensor", "group", "global", "gaussian"]


@dataclass(frozen=True, eq=False)
class OperatorContext:
    """What a Gramian operator may know besides the Gramians.

    Attributes:
        step: 1-based number of the step.
        blocks: [B] name of each Gramian's block (`geometry`, `appearance` under granularity
            `group`, `all` under `global`; under `gaussian` one name for all rows of a block).
        kinds: [B] kind of each.
        losses: [K] float64.
        labels: K group labels, or None.
        distances: [K] float64 camera distances from the mean training camera, local units.
        reference_distance: Their median over all training cameras.
        present: [B, K] bool, views whose gradient of the block is finite and not zero. The rows and
            columns of the others are zero in the Gramian; an operator must give them weight 0.
        unit: Unit roundoff of the gradients' type: no result needs to be closer.
        remainders: Works out [B, K, K], what rounding to float64 took from the Gramians; both
            together have twice the digits. It takes another, slower pass over the gradients: for
            Gramians so close to singular that their own rounding shows. None where nobody knows.
    """

    step: int
    blocks: tuple[str, ...]
    kinds: tuple[BlockKind, ...]
    losses: NDArray[np.float64]
    labels: tuple[str, ...] | None
    distances: NDArray[np.float64]
    reference_distance: float
    present: NDArray[np.bool_]
    unit: float = 2.0**-24
    remainders: Callable[[], NDArray[np.float64]] | None = None


class Operator(Component):
    """Turns the gradients of K views into one per tensor.

    Most operators need only the K x K Gramians and implement `transform`; one that needs the
    elements (GradDrop) overrides `aggregate`.

    Attributes:
        separate: Whether it needs the views' gradients apart. Where not, the backward passes
            accumulate into one gradient: same bits, no copies.
        views: For which K the operator has a meaning.
        idle_at_one: Whether it leaves the gradient of a single view as it is. A run with K = 1 then
            says that the operator does nothing.
        elementwise: Whether it works on elements instead of Gramians; such an operator cannot be a
            link of a chain or serve single blocks.
        granularity: What one Gramian covers: each block's tensors, all geometry / all appearance
            blocks, everything, or each Gaussian's row of a block.
    """

    slot: ClassVar[str] = "operators"
    separate: ClassVar[bool] = True
    views: ClassVar[ViewCounts] = ViewCounts()
    idle_at_one: ClassVar[bool] = False
    elementwise: ClassVar[bool] = False

    granularity: Granularity = Field("tensor", description="what one Gramian covers")

    def does_nothing(self, views: int) -> bool:
        """Whether the result is the plain sum, whatever the gradients of that many views are."""
        return views == 1 and self.idle_at_one

    def reads_gramians(self) -> bool:
        """Whether the Gramians make a difference to its weights; else granularity means nothing."""
        return True

    def reads_labels(self) -> bool:
        """Whether the labels of the views make a difference to it."""
        return False

    @override
    def idle_options(self, selection: Selection) -> Mapping[str, str]:
        if self.reads_gramians():
            return {}
        return {"granularity": "this operator looks at no Gramians; leave it out"}

    @abstractmethod
    def transform(
        self,
        gramians: NDArray[np.float64],
        context: OperatorContext,
        state: PluginState,
        rng: np.random.Generator,
    ) -> tuple[NDArray[np.float64], PluginState]:
        """Replace the K gradients G of each block by M G; the rows of M G are then added.

        Args:
            gramians: [B, K, K] float64, symmetric positive semi-definite up to rounding.
            context: See `OperatorContext`.
            state: What this operator returned last.
            rng: The only source of random numbers.

        Returns:
            [B, R, K] float64 matrices M (R is the operator's choice) and the new state. A chain of
            operators multiplies them: the next link sees M Gram M^T.
        """

    def aggregate(
        self, context: AggregateContext, state: PluginState
    ) -> tuple[Aggregated, PluginState]:
        """The aggregated gradients by way of Gramians, weights and one weighted sum."""
        from crossgrad_core.contract.aggregation import aggregate_by_gramians

        return aggregate_by_gramians(self, context, state)

    @hookimpl
    def crossgrad_aggregate_gradients(self, context: AggregateContext) -> Aggregated:
        """Answers the seam with this operator's directions."""
        aggregated, state = self.aggregate(context, context.state(STATE))
        states: Mapping[str, PluginState] = {**aggregated.states, STATE: state}
        return Aggregated(aggregated.gradients, aggregated.counts, states=states)

    @hookimpl
    def crossgrad_objections(self, selection: Selection) -> list[str]:
        """Refuses numbers of views for which the operator means nothing."""
        if self.views.admits(selection.views_per_step):
            return []
        name = selection.names["operator"]
        return [f"operator {name} needs {self.views}; K = {selection.views_per_step} was asked for"]

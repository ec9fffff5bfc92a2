"""The sampler slot: which views are rendered in a step."""

from abc import abstractmethod
from typing import ClassVar

from crossgrad_core.contract.blocks import PluginState
from crossgrad_core.contract.component import Component, ViewCounts, hookimpl, with_state
from crossgrad_core.contract.contexts import SampleContext, SampleResult, ViewSample

STATE = "sampler"


class Sampler(Component):
    """Chooses the K training views of a step, given its state and the last step's record.

    Attributes:
        views: For which K the sampler has a meaning, unless its options say otherwise.
        default_views: K where the user names none, unless its options say otherwise.
        default_grouping: Name of the grouping it needs unless the user names another; None where
            it needs no groups.
        own_labels: Labels of its draws where it makes its own groups and ignores the grouping.
        reads_groups: Whether the groups of the training views make a difference to its draws.
        groups: How many groups it needs; None for any number.
    """

    slot: ClassVar[str] = "samplers"
    views: ClassVar[ViewCounts] = ViewCounts()
    default_views: ClassVar[int] = 1
    default_grouping: ClassVar[str | None] = None
    own_labels: ClassVar[tuple[str, ...]] = ()
    reads_groups: ClassVar[bool] = True
    groups: ClassVar[int | None] = None

    @property
    def view_counts(self) -> ViewCounts:
        """For which K the sampler has a meaning with its options as they are."""
        return self.views

    @property
    def resolved_views(self) -> int:
        """K where the user names none."""
        return self.default_views

    def counts(self, views: int) -> frozenset[int]:
        """How many views a step of a run with K = `views` may have; by default always K.

        A sampler whose steps differ names all numbers: an operator that has no meaning for one of
        them is refused.
        """
        return frozenset({views})

    @abstractmethod
    def sample(self, context: SampleContext, state: PluginState) -> tuple[ViewSample, PluginState]:
        """The views of this step and the new state. Random numbers come from `context.rng`."""

    @hookimpl
    def crossgrad_sample_views(self, context: SampleContext) -> SampleResult:
        """Answers the hook with this sampler's draw."""
        answer = self.sample(context, context.state(STATE))
        draw, state = with_state(answer, ViewSample, self, "sample")
        return SampleResult(draw, states={STATE: state})

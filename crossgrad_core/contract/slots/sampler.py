"""The sampler slot: a component chooses the views of each step."""

from abc import abstractmethod
from typing import ClassVar

from crossgrad_core.contract.blocks import PluginState
from crossgrad_core.contract.component import Component, ViewCounts, hookimpl, with_state
from crossgrad_core.contract.contexts import SampleContext, SampleResult, ViewSample

STATE = "sampler"


class Sampler(Component):
    """A method that chooses the K views of a step from its state and the record of the last step.

    Attributes:
        views: Supported values of K; options of the sampler may change them.
        default_views: K if the user sets none; options of the sampler may change it.
        default_grouping: Name of the grouping that is used if the user names none; None if the
            sampler needs no groups.
        own_labels: Labels of the samples if the sampler makes its own groups and ignores the
            grouping; else empty.
        reads_groups: True if the samples depend on the groups of the training views.
        groups: Number of groups that the sampler needs; None for any number.
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
        """Values of K that the sampler supports with its present options."""
        return self.views

    @property
    def resolved_views(self) -> int:
        """The value of K if the user sets none."""
        return self.default_views

    def counts(self, views: int) -> frozenset[int]:
        """Return the possible numbers of views per step in a run with K = `views`; by default K.

        A sampler with a varying number of views returns all numbers. An operator that does not
        support one of the numbers is refused.
        """
        return frozenset({views})

    @abstractmethod
    def sample(self, context: SampleContext, state: PluginState) -> tuple[ViewSample, PluginState]:
        """Return the views of this step and the new state.

        Random numbers must come from `context.rng`.
        """

    @hookimpl
    def crossgrad_sample_views(self, context: SampleContext) -> SampleResult:
        """Return this sampler's result for the hook."""
        answer = self.sample(context, context.state(STATE))
        draw, state = with_state(answer, ViewSample, self, "sample")
        return SampleResult(draw, states={STATE: state})

"""The altitude-balanced pair of the paper: near and far views in equal numbers."""

from collections.abc import Mapping
from typing import ClassVar

from pydantic import Field
from typing_extensions import override

from crossgrad_core.plugin import (
    PluginState,
    SampleContext,
    Sampler,
    Selection,
    ViewCounts,
    ViewSample,
)
from crossgrad_plugins.samplers.balanced import balanced_draw, idle_order
from crossgrad_plugins.samplers.draws import Order
from crossgrad_plugins.samplers.groups import groups_of


class NearFar(Sampler):
    """K/2 near and K/2 far views per step, near and far taking turns within the step.

    With `alternating` a step has one view: near in odd steps, far in even ones. Under a grouping
    whose two labels are not near and far, the labels take turns in alphabetical order.

    Source: the paper, altitude-balanced view pairing (one uniform near view and one uniform far
    view, independent).
    """

    views: ClassVar[ViewCounts] = ViewCounts(minimum=2, multiple_of=2)
    default_views: ClassVar[int] = 2
    default_grouping: ClassVar[str | None] = "radial"
    groups: ClassVar[int | None] = 2

    alternating: bool = Field(False, description="one view per step, near and far in turn (K = 1)")
    order: Order = Field(
        "iid",
        description="draws within a group: iid; distinct: no view twice in a step; "
        "epoch: every view once before any comes again",
    )

    @property
    @override
    def view_counts(self) -> ViewCounts:
        return ViewCounts(1, 1) if self.alternating else self.views

    @property
    @override
    def usual_views(self) -> int:
        return 1 if self.alternating else self.default_views

    def unused_options(self, selection: Selection) -> Mapping[str, str]:
        """See `HasUnusedOptions`."""
        return idle_order(self.order, selection.views_per_step, 2)

    @override
    def sample(self, context: SampleContext, state: PluginState) -> tuple[ViewSample, PluginState]:
        groups = groups_of(context, "near-far", 2)
        if self.alternating:
            label = list(groups)[(context.step - 1) % 2]
            groups = {label: groups[label]}
        return balanced_draw(groups, context, state, self.order)

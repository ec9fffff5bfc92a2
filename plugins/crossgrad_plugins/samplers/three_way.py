"""Three-way balanced sampling: one view of each third."""

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


class ThreeWay(Sampler):
    """One near, one middle and one far view per step.

    Three renders per step: compare with the others at equal rendered views, not at equal steps.

    Source: the paper, partition threshold study; groups are thirds of the radial distance.
    """

    views: ClassVar[ViewCounts] = ViewCounts(3, 3)
    default_views: ClassVar[int] = 3
    default_grouping: ClassVar[str | None] = "terciles"
    groups: ClassVar[int | None] = 3

    order: Order = Field(
        "iid",
        description="draws within a group: iid; distinct: no view twice in a step; "
        "epoch: every view once before any comes again",
    )

    def unused_options(self, selection: Selection) -> Mapping[str, str]:
        """See `HasUnusedOptions`."""
        return idle_order(self.order, selection.views_per_step, 3)

    @override
    def sample(self, context: SampleContext, state: PluginState) -> tuple[ViewSample, PluginState]:
        groups = groups_of(context, "three-way", 3)
        return balanced_draw(groups, context, state, self.order)

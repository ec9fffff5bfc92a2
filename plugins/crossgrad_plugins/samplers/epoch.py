"""Epochs without replacement: the order of 3DGS."""

from typing import ClassVar

from typing_extensions import override

from crossgrad_core.plugin import PluginState, SampleContext, Sampler, ViewCounts, ViewSample
from crossgrad_plugins.samplers.draws import EpochOrder, draw, training_views
from crossgrad_plugins.samplers.groups import drawn


class Epoch(Sampler):
    """Every training view once per epoch, in an order that is shuffled anew each time.

    The K views of a step are different; K at most the number of training views.

    Source: 3DGS pops a random element of the remaining views and refills the list when it is empty;
    a shuffled epoch has the same distribution.
    """

    views: ClassVar[ViewCounts] = ViewCounts()
    default_views: ClassVar[int] = 1
    reads_groups: ClassVar[bool] = False

    @override
    def sample(self, context: SampleContext, state: PluginState) -> tuple[ViewSample, PluginState]:
        epoch_order = EpochOrder.from_json(state.values.get("deck"))
        pool = training_views(context)
        views, epoch_order = draw(pool, context.views_per_step, "epoch", epoch_order, context.rng)
        return drawn(views, context), PluginState({"deck": epoch_order.to_json()})

"""Epochs without replacement: the order of 3DGS."""

from typing import ClassVar

from typing_extensions import override

from crossgrad_core.plugin import Draw, PluginState, SampleContext, Sampler, ViewCounts
from crossgrad_plugins.samplers.draws import Deck, draw, training_views
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
    def sample(self, context: SampleContext, state: PluginState) -> tuple[Draw, PluginState]:
        deck = Deck.from_json(state.values.get("deck"))
        pool = training_views(context)
        views, deck = draw(pool, context.views_per_step, "epoch", deck, context.rng)
        return drawn(views, context), PluginState({"deck": deck.to_json()})

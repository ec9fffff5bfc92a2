"""Samplers that treat all training views equally: random views, and epochs."""

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
from crossgrad_plugins.samplers.draws import EpochOrder, Order, draw, drawn, training_views


class Random(Sampler):
    """Draws K uniform training views, independently of each other and of earlier steps.

    Source: the paper, `r2view`. Proposition 2 of the paper assumes independent draws, so
    independent draws are the default.
    """

    views: ClassVar[ViewCounts] = ViewCounts()
    default_views: ClassVar[int] = 2
    reads_groups: ClassVar[bool] = False

    distinct: bool = Field(
        False, description="draw K different views instead of K independent views"
    )

    def unused_options(self, selection: Selection) -> Mapping[str, str]:
        """Return the options that have no effect; see `HasUnusedOptions`."""
        if selection.views_per_step > 1:
            return {}
        return {
            "distinct": (
                "a step has one view (K = 1); leave the option out, or add --views with more views"
            )
        }

    @override
    def sample(self, context: SampleContext, state: PluginState) -> tuple[ViewSample, PluginState]:
        order: Order = "distinct" if self.distinct else "iid"
        pool = training_views(context)
        views, _ = draw(pool, context.views_per_step, order, EpochOrder(), context.rng)
        return drawn(views, context), state


class Epoch(Sampler):
    """Draws every training view once per epoch, in a newly shuffled order each time.

    The K views of a step are all different, so K is at most the number of training views.

    Source: 3DGS removes a random element from the list of remaining views, and refills the list
    when it is empty. A shuffled epoch draws views with equal probabilities.
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

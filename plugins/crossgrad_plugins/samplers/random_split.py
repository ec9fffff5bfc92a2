"""The control of near-far: the same balanced pair over groups that mean nothing."""

from collections.abc import Mapping
from typing import ClassVar, cast

from pydantic import Field
from typing_extensions import override

from crossgrad_core.plugin import (
    Json,
    PluginState,
    SampleContext,
    Sampler,
    Selection,
    UserError,
    ViewCounts,
    ViewSample,
)
from crossgrad_plugins.samplers.balanced import balanced_draw, idle_order
from crossgrad_plugins.samplers.draws import Order, training_views

HALVES = ("first", "second")


class RandomSplit(Sampler):
    """K/2 views of each of two random halves of the training views, drawn once at the first step.

    Any grouping of the run is ignored; the labels of the draw are `first` and `second`.

    Source: the paper announces this control and shows no figures.
    """

    views: ClassVar[ViewCounts] = ViewCounts(minimum=2, multiple_of=2)
    default_views: ClassVar[int] = 2
    reads_groups: ClassVar[bool] = False
    own_labels: ClassVar[tuple[str, ...]] = HALVES

    order: Order = Field(
        "iid",
        description="draws within a half: iid; distinct: no view twice in a step; "
        "epoch: every view once before any comes again",
    )

    def unused_options(self, selection: Selection) -> Mapping[str, str]:
        """See `HasUnusedOptions`."""
        return idle_order(self.order, selection.views_per_step, len(HALVES))

    @override
    def sample(self, context: SampleContext, state: PluginState) -> tuple[ViewSample, PluginState]:
        views = training_views(context)
        if len(views) < len(HALVES):
            raise UserError(
                "sampler random-split needs two training views",
                where="sampler",
                found=str(len(views)),
                todo="choose --sampler epoch",
            )
        if "split" not in state.values:
            shuffled = [int(view) for view in context.rng.permutation(len(views))]
            state = PluginState({**state.values, "split": cast("list[Json]", shuffled)})
        shuffled = cast("list[int]", state.values["split"])
        middle = (len(shuffled) + 1) // 2
        groups = {HALVES[0]: shuffled[:middle], HALVES[1]: shuffled[middle:]}
        return balanced_draw(groups, context, state, self.order)

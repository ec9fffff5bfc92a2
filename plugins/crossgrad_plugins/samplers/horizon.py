"""Far and near views whose ratio changes once: first 2:1, then 1:1."""

from collections.abc import Mapping
from typing import ClassVar, cast

from pydantic import Field, PositiveInt
from typing_extensions import override

from crossgrad_core.plugin import (
    Json,
    PluginState,
    SampleContext,
    Sampler,
    Selection,
    ViewCounts,
    ViewSample,
)
from crossgrad_plugins.samplers.draws import EpochOrder, draw, drawn, groups_of

#: Number of decimals to which a step number is rounded. Further decimals contain only rounding
#: errors.
_DIGITS = 6


class Horizon(Sampler):
    """Draws far and near views in a cycle with a fixed ratio; each group has its own epochs.

    The cycle continues across steps, so the ratio is exact for every K.

    Source: Horizon-GS, which draws aerial and street views at 2 : 1 in its coarse stage (60,000 of
    100,000 steps), and at 1 : 1 in its fine stage.
    """

    views: ClassVar[ViewCounts] = ViewCounts()
    default_views: ClassVar[int] = 1
    default_grouping: ClassVar[str | None] = "radial"
    groups: ClassVar[int | None] = 2

    coarse: tuple[PositiveInt, PositiveInt] = Field(
        (2, 1), description="far : near in the first stage"
    )
    fine: tuple[PositiveInt, PositiveInt] = Field(
        (1, 1), description="far : near in the second stage"
    )
    coarse_share: float = Field(
        0.6, ge=0.0, le=1.0, description="share of the run in the first stage"
    )

    def unused_options(self, selection: Selection) -> Mapping[str, str]:
        """Return the options that have no effect; see `HasUnusedOptions`."""
        if 0.0 < self.coarse_share < 1.0:
            return {}
        name, stage = ("coarse", "first") if self.coarse_share == 0.0 else ("fine", "second")
        return {
            name: (
                f"coarse_share = {self.coarse_share:g} leaves no {stage} stage; leave the "
                "option out"
            )
        }

    @override
    def sample(self, context: SampleContext, state: PluginState) -> tuple[ViewSample, PluginState]:
        near, far = groups_of(context, "horizon", 2).items()
        # Round the product: a share of 0.29 of 100 steps is 29 steps, but floating-point arithmetic
        # gives a slightly different value.
        coarse = context.step <= round(self.coarse_share * context.schedule.total, _DIGITS)
        far_turns, near_turns = self.coarse if coarse else self.fine
        turns = [far] * far_turns + [near] * near_turns
        start = _turn(state, coarse)
        epoch_orders = dict(cast("dict[str, Json]", state.values.get("decks", {})))
        views = []
        for k in range(context.views_per_step):
            label, pool = turns[(start + k) % len(turns)]
            (view,), epoch_order = draw(
                pool, 1, "epoch", EpochOrder.from_json(epoch_orders.get(label)), context.rng
            )
            views.append(view)
            epoch_orders[label] = epoch_order.to_json()
        turn = (start + context.views_per_step) % len(turns)
        values: dict[str, Json] = {"coarse": coarse, "turn": turn, "decks": epoch_orders}
        return drawn(views, context), PluginState(values)


def _turn(state: PluginState, coarse: bool) -> int:
    """Return the position in the cycle of the current stage; a new stage starts at position 0."""
    if state.values.get("coarse") != coarse:
        return 0
    return cast("int", state.values["turn"])

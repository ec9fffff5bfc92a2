"""Samplers that draw equal numbers of views from every group."""

from collections.abc import Mapping, Sequence
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
from crossgrad_plugins.samplers.draws import EpochOrder, Order, draw, groups_of, training_views

HALVES = ("first", "second")


class NearFar(Sampler):
    """Draws K/2 near and K/2 far views per step, alternately.

    With `alternating`, a step has one view: a near view in odd steps, a far view in even steps. If
    the labels of the grouping are not near and far, its two groups alternate in alphabetical order.

    Source: the paper, altitude-balanced view pairing: one uniform near view and one uniform far
    view, drawn independently.
    """

    views: ClassVar[ViewCounts] = ViewCounts(minimum=2, multiple_of=2)
    default_views: ClassVar[int] = 2
    default_grouping: ClassVar[str | None] = "radial"
    groups: ClassVar[int | None] = 2

    alternating: bool = Field(
        False, description="one view per step, alternately near and far (K = 1)"
    )
    order: Order = Field(
        "iid",
        description="draws within a group: iid; distinct: no view twice in a step; epoch: each "
        "view once before any view is repeated",
    )

    @property
    @override
    def view_counts(self) -> ViewCounts:
        return ViewCounts(1, 1) if self.alternating else self.views

    @property
    @override
    def resolved_views(self) -> int:
        return 1 if self.alternating else self.default_views

    def unused_options(self, selection: Selection) -> Mapping[str, str]:
        """Return the options that have no effect; see `HasUnusedOptions`."""
        return idle_order(self.order, selection.views_per_step, 2)

    @override
    def sample(self, context: SampleContext, state: PluginState) -> tuple[ViewSample, PluginState]:
        groups = groups_of(context, "near-far", 2)
        if self.alternating:
            label = list(groups)[(context.step - 1) % 2]
            groups = {label: groups[label]}
        return balanced_draw(groups, context, state, self.order)


class ThreeWay(Sampler):
    """Draws one near, one middle and one far view per step.

    A step renders three views, so compare this sampler with others at equal numbers of rendered
    views, not of steps.

    Source: the paper, partition threshold study; its groups are thirds of the radial distance.
    """

    views: ClassVar[ViewCounts] = ViewCounts(3, 3)
    default_views: ClassVar[int] = 3
    default_grouping: ClassVar[str | None] = "terciles"
    groups: ClassVar[int | None] = 3

    order: Order = Field(
        "iid",
        description="draws within a group: iid; distinct: no view twice in a step; epoch: each "
        "view once before any view is repeated",
    )

    def unused_options(self, selection: Selection) -> Mapping[str, str]:
        """Return the options that have no effect; see `HasUnusedOptions`."""
        return idle_order(self.order, selection.views_per_step, 3)

    @override
    def sample(self, context: SampleContext, state: PluginState) -> tuple[ViewSample, PluginState]:
        groups = groups_of(context, "three-way", 3)
        return balanced_draw(groups, context, state, self.order)


class RandomSplit(Sampler):
    """Draws K/2 views from each of two random halves of the training views.

    The halves are drawn at the first step. The sampler ignores the grouping of the run and labels
    the halves `first` and `second`.

    Source: the paper announces this control experiment but gives no results.
    """

    views: ClassVar[ViewCounts] = ViewCounts(minimum=2, multiple_of=2)
    default_views: ClassVar[int] = 2
    reads_groups: ClassVar[bool] = False
    own_labels: ClassVar[tuple[str, ...]] = HALVES

    order: Order = Field(
        "iid",
        description="draws within a half: iid; distinct: no view twice in a step; epoch: each "
        "view once before any view is repeated",
    )

    def unused_options(self, selection: Selection) -> Mapping[str, str]:
        """Return the options that have no effect; see `HasUnusedOptions`."""
        return idle_order(self.order, selection.views_per_step, len(HALVES))

    @override
    def sample(self, context: SampleContext, state: PluginState) -> tuple[ViewSample, PluginState]:
        views = training_views(context)
        if len(views) < len(HALVES):
            raise UserError(
                "sampler random-split needs at least two training views",
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


def balanced_draw(
    groups: Mapping[str, Sequence[int]], context: SampleContext, state: PluginState, order: Order
) -> tuple[ViewSample, PluginState]:
    """Draw K / len(groups) views from every group; the groups alternate within the step.

    Args:
        groups: Label -> indices of the training views in the group; the groups alternate in this
            order.
        context: The context of the step.
        state: The state that the previous call of this function returned. With order `epoch` the
            state contains one `EpochOrder` per label.
        order: How views are drawn within a group.
    """
    share = context.views_per_step // len(groups)
    values = dict(state.values)
    columns = []
    for label, pool in groups.items():
        column, epoch_order = draw(
            pool, share, order, EpochOrder.from_json(values.get(label)), context.rng
        )
        columns.append(column)
        if order == "epoch":
            values[label] = epoch_order.to_json()
    views = tuple(view for row in zip(*columns, strict=True) for view in row)
    return ViewSample(views, tuple(groups) * share), PluginState(values)


def idle_order(order: Order, views: int, groups: int) -> Mapping[str, str]:
    """Return the option `order` and the reason if it has no effect, else an empty mapping."""
    if order != "distinct" or views > groups:
        return {}
    why = "a step has one view of each group, so distinct draws the same views as iid"
    return {"order": f"{why}; leave the option out, or choose epoch"}

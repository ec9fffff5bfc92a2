"""Equal numbers of views from every group."""

from collections.abc import Mapping, Sequence

from crossgrad_core.plugin import PluginState, SampleContext, ViewSample
from crossgrad_plugins.samplers.draws import EpochOrder, Order, draw


def balanced_draw(
    groups: Mapping[str, Sequence[int]], context: SampleContext, state: PluginState, order: Order
) -> tuple[ViewSample, PluginState]:
    """K / len(groups) views of every group, the groups taking turns within the step.

    Args:
        groups: Label -> positions of its training views, in the order of the turns.
        context: The step.
        state: What this function returned last; holds one deck per label under order `epoch`.
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
    """The option `order` where it changes nothing: one view of a group is never drawn twice."""
    if order != "distinct" or views > groups:
        return {}
    why = "a step has one view of each group, which distinct leaves as iid draws it"
    return {"order": f"{why}; leave it out, or choose epoch"}

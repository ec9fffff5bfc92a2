"""Anchor pairs: near cameras are paired with far cameras, middle cameras with middle cameras."""

from collections.abc import Mapping, Sequence
from typing import ClassVar

from typing_extensions import override

from crossgrad_core.plugin import (
    PluginState,
    SampleContext,
    Sampler,
    Selection,
    UserError,
    ViewCounts,
    ViewSample,
    hookimpl,
)
from crossgrad_plugins.samplers.draws import drawn, members_of, training_views

_OPPOSITE = {"near": "far", "far": "near"}


class Anchors30(Sampler):
    """A uniform view, and a partner from the opposite anchor group (middle views: from the middle).

    Intended for operator `anchors`, which projects only between the views of an anchor pair.

    Source: the paper, operator variants (the nearest and farthest 30 % are anchors; the sampling
    rule was developed for crossgrad).
    """

    views: ClassVar[ViewCounts] = ViewCounts(2, 2)
    default_views: ClassVar[int] = 2
    default_grouping: ClassVar[str | None] = "anchors"

    @hookimpl
    def crossgrad_validate_selection(self, selection: Selection) -> list[str]:
        """Return an objection if the grouping has no near or no far group."""
        if selection.labels is not None and not {"near", "far"} <= set(selection.labels):
            return [
                (
                    "sampler anchors-30 needs groups labelled near and far, but grouping "
                    f"{selection.names['grouping']} makes {', '.join(selection.labels)}"
                )
            ]
        return []

    @override
    def sample(self, context: SampleContext, state: PluginState) -> tuple[ViewSample, PluginState]:
        groups = _anchor_groups(context)
        labels = context.groups or ()
        first = int(context.rng.integers(len(training_views(context))))
        partners = groups[_OPPOSITE.get(labels[first], labels[first])]
        second = partners[int(context.rng.integers(len(partners)))]
        return drawn((first, second), context), state


def _anchor_groups(context: SampleContext) -> Mapping[str, Sequence[int]]:
    """Return the training views of each label.

    Raises:
        UserError: There is no grouping with labels near and far.
    """
    groups = members_of(context)
    if "near" not in groups or "far" not in groups:
        raise UserError(
            "sampler anchors-30 needs training views labelled near and far",
            where="sampler, grouping",
            expected="labels near and far; other views may have any other label",
            found=", ".join(groups) if groups else "no grouping",
            todo="choose --grouping anchors or --grouping terciles",
        )
    return groups

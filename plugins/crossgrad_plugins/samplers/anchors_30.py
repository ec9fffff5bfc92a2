"""Anchor pairs: the nearest and the farthest cameras meet each other, the middle meets itself."""

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
    """A uniform view, and a partner: of the opposite anchor group, or of the middle for the middle.

    Meant with operator `anchors`, which projects only between an anchor pair.

    Source: the paper, operator variants (nearest and farthest 30 % are anchors; the rule of the
    draw is ours).
    """

    views: ClassVar[ViewCounts] = ViewCounts(2, 2)
    default_views: ClassVar[int] = 2
    default_grouping: ClassVar[str | None] = "anchors"

    @hookimpl
    def crossgrad_validate_selection(self, selection: Selection) -> list[str]:
        """Refuses groups without near and far ones."""
        if selection.labels is not None and not {"near", "far"} <= set(selection.labels):
            return [
                "sampler anchors-30 needs groups labelled near and far; grouping "
                f"{selection.names['grouping']} gives {', '.join(selection.labels)}"
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
    """Label -> training views.

    Raises:
        UserError: There is no grouping with labels near and far.
    """
    groups = members_of(context)
    if "near" not in groups or "far" not in groups:
        raise UserError(
            "sampler anchors-30 needs training views labelled near and far",
            where="sampler, grouping",
            expected="labels near and far, and any label for the views between",
            found=", ".join(groups) if groups else "no grouping",
            todo="choose --grouping anchors or --grouping terciles",
        )
    return groups

"""Anchor pairs: a near and a far camera, or two middle cameras."""

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
    """Draws a uniform view, and a partner from the opposite anchor group.

    The partner of a middle view is a middle view. The sampler is intended for operator `anchors`,
    which projects gradients only between the near and the far view of a pair.

    Source: the paper, operator variants, which defines the anchors as the nearest and farthest 30
    %; the sampling rule was developed for crossgrad.
    """

    views: ClassVar[ViewCounts] = ViewCounts(2, 2)
    default_views: ClassVar[int] = 2
    default_grouping: ClassVar[str | None] = "anchors"

    @hookimpl
    def crossgrad_validate_selection(self, selection: Selection) -> list[str]:
        """Return an objection if the grouping has no near group or no far group."""
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

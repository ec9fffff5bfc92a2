"""Checks for operators that need the group of each view."""

from collections.abc import Mapping
from types import MappingProxyType

from crossgrad_core.plugin import OperatorContext, Selection, UserError


def labels_of(context: OperatorContext, operator: str) -> tuple[str, ...]:
    """Return the labels of the views, which name their groups.

    Raises:
        UserError: The views have no labels.
    """
    if context.labels is None:
        raise UserError(
            f"operator {operator} needs the group of each view",
            expected="views with labels",
            found="views without labels",
            todo="choose a sampler that draws from groups, such as near-far",
        )
    return context.labels


def label_objections(
    selection: Selection, needed: Mapping[str, str] = MappingProxyType({})
) -> list[str]:
    """Return reasons why views will have no labels, or will lack labels that the options name."""
    name, sampler = selection.names["operator"], selection.names["sampler"]
    grouping = selection.grouping
    if selection.sampler.own_labels:
        source, given = f"sampler {sampler}", selection.sampler.own_labels
    elif grouping is not None:
        # A grouping by folders or lists takes its labels from the scene. The field `labels` of such
        # a grouping is empty.
        source = f"grouping {selection.names['grouping']}"
        given = grouping.labels if selection.labels is None else selection.labels
    else:
        return [
            (f"operator {name} needs labelled views, but sampler {sampler} draws without groups")
        ]
    if not given or set(needed.values()) <= set(given):
        return []
    wanted = " and ".join(f"{label} (operator.{option})" for option, label in needed.items())
    return [
        (
            f"operator {name} needs views labelled {wanted}, but {source} makes "
            f"{', '.join(given)}: set these options to existing labels"
        )
    ]

"""Operators that need to know which group each view comes from."""

from collections.abc import Sequence
from typing import cast

from crossgrad_core.component import Selection
from crossgrad_core.errors import UserError
from crossgrad_core.grouping import Grouping
from crossgrad_core.operator import OperatorContext


def labels_of(context: OperatorContext, operator: str) -> tuple[str, ...]:
    """The labels of the views.

    Raises:
        UserError: The views have none.
    """
    if context.labels is None:
        raise UserError(
            f"operator {operator} needs to know which group each view comes from",
            expected="views with labels",
            found="views without labels",
            todo="choose a sampler that draws from groups, such as near-far",
        )
    return context.labels


def label_objections(selection: Selection, needed: Sequence[str] = ()) -> list[str]:
    """Reasons why views will not carry (the needed) labels."""
    name, sampler = selection.names["operator"], selection.names["sampler"]
    grouping = cast("Grouping | None", selection.components.get("grouping"))
    if selection.sampler.own_labels:
        source, given = f"sampler {sampler}", selection.sampler.own_labels
    elif grouping is not None:
        source, given = f"grouping {selection.names['grouping']}", grouping.labels
    else:
        return [f"operator {name} needs labelled views; sampler {sampler} draws from no groups"]
    # A grouping by folders or lists learns its labels from the scene and declares none.
    if not given or set(needed) <= set(given):
        return []
    return [
        f"operator {name} needs the labels {', '.join(needed)}; {source} gives {', '.join(given)}"
    ]

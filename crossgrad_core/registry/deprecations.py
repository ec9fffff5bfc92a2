"""Changes since crossgrad 0.1 that its plugins meet, and what to do about them."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from crossgrad_core.contract.component import Component

DOOR: Final = "crossgrad_core.plugin"


@dataclass(frozen=True)
class Change:
    """A change of a slot's base class.

    Attributes:
        attribute: What a class of 0.1 defines.
        applies: Whether a class that defines it is of 0.1.
        now: What is written instead.
    """

    attribute: str
    applies: "Callable[[type[Component]], bool]"
    now: str


def _lacks(method: str) -> "Callable[[type[Component]], bool]":
    return lambda found: method in getattr(found, "__abstractmethods__", ())


_CHANGES: Final = {
    "operators": (
        Change(
            "transform",
            _lacks("aggregate"),
            f"derive the class from GramianOperator of {DOOR}, which has transform; from Weighting "
            "with the method weights where a view gets one weight per block; from MatrixOperator "
            "where the Gramians make no difference",
        ),
    ),
    "groupings": (
        Change(
            "label",
            _lacks("fit"),
            "write fit(self, scene, rng, probe=None) -> Rule: it is fitted on scene.train_views, "
            "and its Rule labels any views",
        ),
    ),
    "densifiers": (
        Change(
            "blocks",
            lambda _: True,
            "call the class attribute with the names of tensors `tensors`",
        ),
    ),
}
#: Names that the door had in 0.1.
_NAMES: Final = {
    "Labelling": "Rule, which Grouping.fit answers",
    "NoEdit": "Edit, which may be empty: NO_EDIT is Edit()",
    "ViewGradients": "SeparateGradients",
}
#: How Python says which name a module does not have.
_ASKED: Final = re.compile(r"cannot import name '(\w+)'")


def change_of(slot: str, found: "type[Component]") -> Change | None:
    """What of 0.1 a class of a slot still does; None where nothing is known."""
    for change in _CHANGES.get(slot, ()):
        if hasattr(found, change.attribute) and change.applies(found):
            return change
    return None


def change_of_import(error: BaseException) -> str:
    """What to import instead of what an older version had; empty where the error is another one."""
    if not isinstance(error, ImportError) or not (error.name or "").startswith("crossgrad_core"):
        return ""
    if error.name == DOOR:
        asked = _ASKED.search(str(error))
        name = "" if asked is None else asked[1]
        return f"{name} of crossgrad 0.1 is now {_NAMES[name]}" if name in _NAMES else ""
    return (
        f"crossgrad 0.2 has other modules than 0.1: import what a plugin needs from {DOOR}, whose "
        "names stay"
    )

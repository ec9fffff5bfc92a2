"""A plugin in words: docstring, options, bounds, origin. Imports the plugin."""

import inspect
from textwrap import fill, indent
from typing import Any, Literal, get_args, get_origin

from pydantic.fields import FieldInfo

from crossgrad_core import registry
from crossgrad_core.component import Component
from crossgrad_core.wording import listed, singular

_WIDTH = 80
_MARGIN = "  "
_SIGNS = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<", "multiple_of": "a multiple of"}
_LENGTHS = {"min_length": "at least", "max_length": "at most"}
#: Class attributes that say what a component needs or gives, with their label.
_TRAITS = {
    "views": "views per step",
    "default_views": "default views",
    "default_grouping": "default grouping",
    "default_densifier": "default densifier",
    "labels": "labels",
    "needs": "needs statistics",
    "provides": "provides",
    "devices": "devices",
}


def describe(entry: registry.Entry) -> str:
    """Everything a user wants to know before choosing a plugin, in 80 columns.

    Raises:
        UserError: The plugin cannot be loaded.
    """
    component = registry.load_entry(entry)
    parts = [
        f"{singular(entry.slot)} {entry.name}\n{_MARGIN}{entry.origin}",
        indent(_rewrapped(inspect.getdoc(component) or "No description."), _MARGIN),
        "\n".join(f"{_MARGIN}{label}: {text}" for label, text in _traits(component)),
        _options(entry, component),
    ]
    return "\n\n".join(part for part in parts if part)


def _rewrapped(docstring: str) -> str:
    """The docstring with its plain paragraphs filled to the width; lists stay as they are."""
    blocks = docstring.split("\n\n")
    return "\n\n".join(block if "\n " in block else _filled(block) for block in blocks)


def _filled(text: str) -> str:
    return fill(" ".join(text.split()), _WIDTH - len(_MARGIN))


def _traits(component: type[Component]) -> list[tuple[str, str]]:
    found = []
    for attribute, label in _TRAITS.items():
        if attribute not in component.model_fields and hasattr(component, attribute):
            value = getattr(component, attribute)
            many = isinstance(value, frozenset | tuple)
            if value:
                found.append((label, listed(sorted(value)) if many else str(value)))
    return found


def _options(entry: registry.Entry, component: type[Component]) -> str:
    fields = component.model_fields
    if not fields:
        return f"{_MARGIN}no options"
    word = singular(entry.slot)
    prefix = f"observers.{entry.name}" if entry.slot == "observers" else word
    heading = f"{_MARGIN}options (--set {prefix}.OPTION=VALUE):"
    return "\n".join([heading, *(_option(name, field) for name, field in fields.items())])


def _option(name: str, field: FieldInfo) -> str:
    default = "required" if field.is_required() else f"default {field.default}"
    facts = ", ".join([_type_name(field.annotation), default, *_bounds(field.metadata)])
    text = fill(field.description or "no description", _WIDTH - 8)
    return f"{_MARGIN * 2}{name}  ({facts})\n{indent(text, _MARGIN * 4)}"


def _type_name(annotation: object) -> str:
    if get_origin(annotation) is Literal:
        return " | ".join(str(choice) for choice in get_args(annotation))
    return annotation.__name__ if isinstance(annotation, type) else str(annotation)


def _bounds(constraints: list[Any]) -> list[str]:
    """`>= 0` for each bound that pydantic holds."""
    found = [
        f"{sign} {getattr(constraint, attribute)}"
        for constraint in constraints
        for attribute, sign in _SIGNS.items()
        if getattr(constraint, attribute, None) is not None
    ]
    return found + [
        f"{words} {getattr(constraint, attribute)} items"
        for constraint in constraints
        for attribute, words in _LENGTHS.items()
        if getattr(constraint, attribute, None) is not None
    ]

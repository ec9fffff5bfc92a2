"""The description of a plugin: docstring, options, bounds, origin.

The plugin is imported for the description.
"""

import inspect
import json
from textwrap import fill, indent
from types import UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union, get_args, get_origin

from pydantic.fields import FieldInfo

from crossgrad_core.commands import (
    COMMANDS,
    MANY,
    Entry,
    listed,
    load_command,
    load_entry,
    singular,
    summary,
)

if TYPE_CHECKING:
    from crossgrad_core.plugin import Component

_WIDTH = 80
_MARGIN = "  "
#: Sections of docstrings that are written for developers and not for users.
_SECTIONS = ("Attributes:", "Args:", "Returns:", "Raises:")
_SIGNS = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<", "multiple_of": "a multiple of"}
_LENGTHS = {"min_length": "at least", "max_length": "at most"}
#: Class attributes with the requirements and results of a component -> label in the description.
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


def describe(entry: Entry) -> str:
    """Describe a plugin for users who choose one, in 80 columns.

    Raises:
        UserError: The plugin cannot be loaded.
    """
    if entry.slot == COMMANDS:
        return _described_command(entry)
    component = load_entry(entry)
    parts = [
        _heading(entry),
        indent(_prose(inspect.getdoc(component) or "No description."), _MARGIN),
        "\n".join(f"{_MARGIN}{label}: {text}" for label, text in _traits(component)),
        _options(entry, component),
    ]
    return "\n\n".join(section for section in parts if section)


def _heading(entry: Entry) -> str:
    word = singular(entry.slot)
    return f"{word} {entry.name}, from {entry.distribution} {entry.version}\n{_MARGIN}{entry.value}"


def _described_command(entry: Entry) -> str:
    """Describe a command.

    Its options are described by its own help text.
    """
    load_command(entry)
    hint = f"`crossgrad {entry.name} --help` explains its options"
    return "\n\n".join([_heading(entry), indent(_prose(f"{summary(entry)}\n\n{hint}"), _MARGIN)])


def _prose(docstring: str) -> str:
    """Wrap a docstring, but leave out the sections for developers."""
    blocks = [block for block in docstring.split("\n\n") if not block.startswith(_SECTIONS)]
    return "\n\n".join(_filled(block) for block in blocks)


def _filled(block: str) -> str:
    """Fill a paragraph to the width; if lines are indented, fill each line separately."""
    lines = block.splitlines() if "\n " in block else [" ".join(block.split())]
    width = _WIDTH - len(_MARGIN)
    return "\n".join(
        fill(line, width, subsequent_indent=" " * (len(line) - len(line.lstrip())))
        for line in lines
    )


def _traits(component: "type[Component]") -> list[tuple[str, object]]:
    traits: list[tuple[str, object]] = []
    for attribute, label in _TRAITS.items():
        if attribute not in component.model_fields and hasattr(component, attribute):
            value = getattr(component, attribute)
            if isinstance(value, property):
                continue
            value = sorted(value) if isinstance(value, frozenset) else value
            if value:
                traits.append((label, listed(value) if isinstance(value, list | tuple) else value))
    return traits


def _options(entry: Entry, component: "type[Component]") -> str:
    fields = component.model_fields
    if not fields:
        return f"{_MARGIN}no options"
    prefix = f"{entry.slot}.{entry.name}" if entry.slot in MANY else singular(entry.slot)
    heading = f"{_MARGIN}options (--set {prefix}.OPTION=VALUE):"
    return "\n".join([heading, *(_option(name, field) for name, field in fields.items())])


def _option(name: str, field: FieldInfo) -> str:
    default = "required" if field.is_required() else f"default {_value(field.default)}"
    facts = ", ".join([_type_name(field.annotation), default, *_bounds(field.metadata)])
    text = field.description or "no description"
    rows = (f"{_MARGIN * 2}{name}  ({facts})", f"{_MARGIN * 4}{text}")
    return "\n".join(fill(row, _WIDTH, subsequent_indent=_MARGIN * 4) for row in rows)


def _value(default: object) -> str:
    """Format a value as users write it after `--set KEY=`."""
    return default if isinstance(default, str) else json.dumps(default, default=str)


def _type_name(annotation: object) -> str:
    """Return the type as text: choices and unions joined by a bar, without constraints."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _type_name(arguments[0])
    if origin is Literal:
        return " | ".join(str(choice) for choice in arguments)
    names = [_type_name(argument) for argument in arguments if argument is not Ellipsis]
    if origin in (Union, UnionType):
        return " | ".join(names)
    if annotation is type(None):
        return "null"
    word = getattr(origin or annotation, "__name__", str(annotation))
    return f"{word} of {', '.join(names)}" if names else word


def _bounds(constraints: list[Any]) -> list[str]:
    """Return a text such as `>= 0` for each bound of pydantic."""
    bounds = [
        f"{sign} {getattr(constraint, attribute)}"
        for constraint in constraints
        for attribute, sign in _SIGNS.items()
        if getattr(constraint, attribute, None) is not None
    ]
    return bounds + [
        f"{words} {getattr(constraint, attribute)} items"
        for constraint in constraints
        for attribute, words in _LENGTHS.items()
        if getattr(constraint, attribute, None) is not None
    ]

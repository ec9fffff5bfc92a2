"""Operators made of operators: by name, in configurations, and with their states side by side."""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Annotated, Any, TypeAlias

from pydantic import BeforeValidator, PlainSerializer

from crossgrad_core.plugin import (
    GramianOperator,
    MatrixOperator,
    Operator,
    PluginState,
    Selection,
    build_component,
    component_name,
    objections_to_views,
    plain_component,
    set_for_nothing,
)

STATE_SEPARATOR = "/"


def operator_of(value: object) -> MatrixOperator:
    """An operator from itself, from its name, or from `{name: ..., option: ...}`."""
    if isinstance(value, Operator):
        return _checked(value)
    if isinstance(value, str):
        value = {"name": value}
    if not isinstance(value, Mapping) or "name" not in value:
        raise ValueError("must be an operator's name, or a name with options")
    options = {key: option for key, option in value.items() if key != "name"}
    return _checked(build_component(Operator, str(value["name"]), options))


def _checked(operator: Operator) -> MatrixOperator:
    if not isinstance(operator, MatrixOperator):
        raise ValueError(  # noqa: TRY004 - pydantic turns it into an error of validation
            f"{component_name(operator)} needs the gradients themselves, and can only stand alone"
        )
    if isinstance(operator, GramianOperator) and operator.granularity != "block":
        raise ValueError(
            f"{component_name(operator)} cannot have a granularity of its own here; set it on the "
            "whole"
        )
    return operator


#: A field that holds an operator and is written as its name with its options.
OperatorField: TypeAlias = Annotated[
    MatrixOperator, BeforeValidator(operator_of), PlainSerializer(plain_component)
]


def reads_gramians(operators: Iterable[MatrixOperator]) -> bool:
    """Whether the Gramians make a difference to any of these operators."""
    return any(isinstance(each, GramianOperator) and each.reads_gramians() for each in operators)


def first_grouping(operators: Iterable[MatrixOperator]) -> str | None:
    """The grouping that the first of them needs that needs one."""
    return next(filter(None, (each.resolved_grouping for each in operators)), None)


def inner_state(state: PluginState, key: str) -> PluginState:
    """The part of a state that belongs to the inner operator of that key."""
    start = key + STATE_SEPARATOR
    return PluginState(
        values=_inner(state.values, start),
        tensors=_inner(state.tensors, start),
        per_primitive=_inner(state.per_primitive, start),
    )


def outer_state(states: Mapping[str, PluginState]) -> PluginState:
    """One state from those of all inner operators, by key."""
    return PluginState(
        values=_outer({key: state.values for key, state in states.items()}),
        tensors=_outer({key: state.tensors for key, state in states.items()}),
        per_primitive=_outer({key: state.per_primitive for key, state in states.items()}),
    )


def inner_objections(selection: Selection, operator: Operator) -> list[str]:
    """What an inner operator objects to in a selection."""
    name = component_name(operator)
    seen = replace(selection, operator=operator, names={**selection.names, "operator": name})
    own = getattr(operator, "crossgrad_validate_selection", None)
    return objections_to_views(operator, seen) + list(own(seen) or () if own else ())


def inner_idle(selection: Selection, option: str, operators: Iterable[Operator]) -> dict[str, str]:
    """The option that holds inner operators, where one of these has options that do nothing."""
    found = [
        f"{component_name(operator)}.{name}: {why}"
        for operator in operators
        for name, why in set_for_nothing(operator, selection).items()
    ]
    return {option: "; ".join(found)} if found else {}


def _inner(values: Mapping[str, Any], start: str) -> dict[str, Any]:
    return {
        name.removeprefix(start): value for name, value in values.items() if name.startswith(start)
    }


def _outer(parts: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    return {
        f"{key}{STATE_SEPARATOR}{name}": value
        for key, values in parts.items()
        for name, value in values.items()
    }

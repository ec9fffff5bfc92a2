"""Operators that contain other operators.

Inner operators are built from names or options, and their states are nested.
"""

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
    """Return an operator. The value is an operator, its name, or `{name: ..., option: ...}`."""
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
            f"{component_name(operator)} reads the gradients themselves and cannot be "
            "used inside another operator"
        )
    if isinstance(operator, GramianOperator) and operator.granularity != "block":
        raise ValueError(
            f"{component_name(operator)} cannot have its own granularity here; set the "
            "granularity on the outer operator"
        )
    return operator


#: A pydantic field that contains an operator. The operator is serialized as its name and options.
OperatorField: TypeAlias = Annotated[
    MatrixOperator, BeforeValidator(operator_of), PlainSerializer(plain_component)
]


def reads_gramians(operators: Iterable[MatrixOperator]) -> bool:
    """Return True if the result of any operator depends on the Gramians."""
    return any(
        isinstance(operator, GramianOperator) and operator.reads_gramians()
        for operator in operators
    )


def first_grouping(operators: Iterable[MatrixOperator]) -> str | None:
    """Return the grouping of the first operator that needs a grouping.

    Return None if no operator needs a grouping.
    """
    return next(filter(None, (operator.resolved_grouping for operator in operators)), None)


def inner_state(state: PluginState, key: str) -> PluginState:
    """Return the part of a state that belongs to the inner operator with key `key`."""
    start = key + STATE_SEPARATOR
    return PluginState(
        values=_inner(state.values, start),
        tensors=_inner(state.tensors, start),
        per_primitive=_inner(state.per_primitive, start),
    )


def outer_state(states: Mapping[str, PluginState]) -> PluginState:
    """Return a state that contains the states of all inner operators, by key."""
    return PluginState(
        values=_outer({key: state.values for key, state in states.items()}),
        tensors=_outer({key: state.tensors for key, state in states.items()}),
        per_primitive=_outer({key: state.per_primitive for key, state in states.items()}),
    )


def inner_objections(selection: Selection, operator: Operator) -> list[str]:
    """Return the objections of an inner operator to the selected components."""
    name = component_name(operator)
    seen = replace(selection, operator=operator, names={**selection.names, "operator": name})
    validate = getattr(operator, "crossgrad_validate_selection", None)
    return objections_to_views(operator, seen) + list(validate(seen) or () if validate else ())


def inner_idle(selection: Selection, option: str, operators: Iterable[Operator]) -> dict[str, str]:
    """Return a message for `option` if the inner operators have options without effect."""
    messages = [
        f"{component_name(operator)}.{name}: {why}"
        for operator in operators
        for name, why in set_for_nothing(operator, selection).items()
    ]
    return {option: "; ".join(messages)} if messages else {}


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

"""The options of a command, made from the fields of a dataclass."""

from collections.abc import Callable
from dataclasses import MISSING, field, fields
from functools import wraps
from inspect import Parameter, Signature
from typing import Annotated, Any, TypeVar, cast, get_type_hints

import typer

_Given = TypeVar("_Given")
_INFO = "option of the command line"


def argument(metavar: str, help: str, default: Any = MISSING) -> Any:  # noqa: A002, ANN401 - typer's
    """Return a field that is an argument of the command, required if it has no default."""
    info = typer.Argument(metavar=metavar, help=help, show_default=False)
    return field(default=default, metadata={_INFO: info})


def option(
    default: Any,  # noqa: ANN401 - the type is the field's
    help: str,  # noqa: A002 - typer's name
    metavar: str | None = None,
    *,
    heading: str | None = None,
    flag: str = "",
    **bounds: float,
) -> Any:  # noqa: ANN401
    """Return a field that is an option of the command.

    Args:
        default: Its value if the user does not give it.
        help: Its help.
        metavar: What the help shows for its value.
        heading: The heading of the help below which it is listed.
        flag: Its name, if it is not the field's.
        **bounds: `min` and `max` of a number.
    """
    known: dict[str, Any] = {"metavar": metavar, "rich_help_panel": heading, **bounds}
    info = typer.Option(*([flag] if flag else []), help=help, **known)
    return field(default=default, metadata={_INFO: info})


def command_of(
    options: type[_Given],
) -> Callable[[Callable[[_Given], None]], Callable[..., None]]:
    """Return a decorator that makes a command of a function.

    Args:
        options: A dataclass whose fields are `argument`s and `option`s. The function gets one.
    """
    kinds = get_type_hints(options)
    parameters = [
        Parameter(
            each.name,
            Parameter.KEYWORD_ONLY,
            default=Parameter.empty if each.default is MISSING else each.default,
            annotation=Annotated[kinds[each.name], each.metadata[_INFO]],
        )
        for each in fields(cast("Any", options))
    ]

    def decorated(function: Callable[[_Given], None]) -> Callable[..., None]:
        @wraps(function)
        def command(**given: Any) -> None:  # noqa: ANN401 - typed by the fields
            function(options(**given))

        command.__dict__["__signature__"] = Signature(parameters)
        command.__annotations__ = {each.name: each.annotation for each in parameters}
        return command

    return decorated

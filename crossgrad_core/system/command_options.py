"""Options of a command, generated from the fields of a dataclass and grouped under headings.

The help does not use the package rich, because importing rich would double the start-up time.
"""

from collections.abc import Callable
from dataclasses import MISSING, field, fields
from functools import wraps
from inspect import Parameter, Signature
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, cast, get_type_hints

import typer
from typer.core import TyperCommand, TyperOption
from typing_extensions import override

if TYPE_CHECKING:
    from typer._click import Context, HelpFormatter


_Given = TypeVar("_Given")
_INFO = "option of the command line"


def argument(metavar: str, help: str, default: Any = MISSING) -> Any:  # noqa: A002, ANN401 - the signature is typer's
    """Return a dataclass field for an argument of the command, required if it has no default."""
    info = typer.Argument(metavar=metavar, help=help, show_default=False)
    return field(default=default, metadata={_INFO: info})


def option(
    default: Any,  # noqa: ANN401 - the type is the type of the field
    help: str,  # noqa: A002 - typer's name
    metavar: str | None = None,
    *,
    heading: str | None = None,
    flag: str = "",
    **bounds: float,
) -> Any:  # noqa: ANN401
    """Return a dataclass field for an option of the command.

    Args:
        default: Value of the option if the user does not give it.
        help: Help text of the option.
        metavar: Placeholder for the value in the help text.
        heading: Heading under which the help text lists the option.
        flag: Name of the option, if it differs from the name of the field.
        **bounds: `min` and `max` of a number.
    """
    arguments: dict[str, Any] = {"metavar": metavar, "rich_help_panel": heading, **bounds}
    info = typer.Option(*([flag] if flag else []), help=help, **arguments)
    return field(default=default, metadata={_INFO: info})


def command_of(
    options: type[_Given],
) -> Callable[[Callable[[_Given], None]], Callable[..., None]]:
    """Return a decorator that turns a function into a command.

    Args:
        options: A dataclass whose fields are results of `argument` and `option`. The function
            receives one instance of this dataclass.
    """
    kinds = get_type_hints(options)
    parameters = [
        Parameter(
            member.name,
            Parameter.KEYWORD_ONLY,
            default=Parameter.empty if member.default is MISSING else member.default,
            annotation=Annotated[kinds[member.name], member.metadata[_INFO]],
        )
        for member in fields(cast("Any", options))
    ]

    def decorated(function: Callable[[_Given], None]) -> Callable[..., None]:
        @wraps(function)
        def command(**given: Any) -> None:  # noqa: ANN401 - typed by the fields
            function(options(**given))

        command.__dict__["__signature__"] = Signature(parameters)
        command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
        return command

    return decorated


class GroupedCommand(TyperCommand):
    """A command whose help lists the options under their headings (`rich_help_panel`)."""

    @override
    def format_options(self, ctx: "Context", formatter: "HelpFormatter") -> None:
        """Write the arguments, the options with headings and the options without a heading."""
        groups: dict[str, list[tuple[str, str]]] = {"Arguments": []}
        others: list[tuple[str, str]] = []
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            argument = parameter.param_type_name == "argument"
            title = "Arguments" if argument else getattr(parameter, "rich_help_panel", None)
            if record is not None:
                (groups.setdefault(title, []) if title else others).append(record)
        for title, records in {**groups, "Options": others}.items():
            if records:
                with formatter.section(title):
                    formatter.write_dl(records)


def print_all_options(context: typer.Context, wanted: bool) -> None:
    """Print the help with the options that `--help` hides, and end the command.

    Args:
        context: The command.
        wanted: True if the user gave the option.
    """
    if wanted:
        for parameter in context.command.params:
            if isinstance(parameter, TyperOption):
                parameter.hidden = False
        typer.echo(context.get_help())
        raise typer.Exit

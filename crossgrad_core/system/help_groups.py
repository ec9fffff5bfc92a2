"""Help that groups options under headings, without rich (which would double the start-up time)."""

from typing import TYPE_CHECKING

import typer
from typer.core import TyperCommand, TyperOption
from typing_extensions import override

if TYPE_CHECKING:
    from typer._click import Context, HelpFormatter


class GroupedCommand(TyperCommand):
    """A command whose help lists options by their `rich_help_panel`."""

    @override
    def format_options(self, ctx: "Context", formatter: "HelpFormatter") -> None:
        """Writes arguments, groups of options in the order of their declaration, and the rest."""
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
        wanted: Whether the user asked for it.
    """
    if wanted:
        for parameter in context.command.params:
            if isinstance(parameter, TyperOption):
                parameter.hidden = False
        typer.echo(context.get_help())
        raise typer.Exit

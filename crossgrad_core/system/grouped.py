"""Help that groups options under headings, without rich (which would double the start-up time)."""

from typing import TYPE_CHECKING

from typer.core import TyperCommand
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

"""Commands that plugins bring: listed in `crossgrad --help`, imported when they are called."""

from typing import TYPE_CHECKING, Any

import typer
from typer.core import TyperCommand, TyperGroup
from typing_extensions import override

from crossgrad_core.registry import entries as registry
from crossgrad_core.registry.commands import as_group_member, load_command, summary
from crossgrad_core.registry.slots import COMMANDS

if TYPE_CHECKING:
    from typer._click import Command, Context

#: Exit status after an interrupt from the keyboard: 128 + SIGINT.
INTERRUPTED = 130


class WithPlugins(TyperGroup):
    """The core's commands, and behind them those of installed plugins.

    Other packages are looked at only where the core's own commands do not answer; a plugin cannot
    replace one of them.
    """

    @override
    def get_command(self, ctx: "Context", cmd_name: str) -> "Command | None":
        """The command of that name."""
        if cmd_name not in self.commands:
            self._add_plugins()
        return super().get_command(ctx, cmd_name)

    @override
    def list_commands(self, ctx: "Context") -> list[str]:
        """The names of all commands."""
        self._add_plugins()
        return super().list_commands(ctx)

    @override
    def invoke(self, ctx: "Context") -> object:
        """Runs a command; an interrupt ends it with the status that shells expect."""
        try:
            return super().invoke(ctx)
        except typer.BadParameter as error:
            error.message = _plain(error)
            raise
        except KeyboardInterrupt:
            typer.echo("interrupted", err=True)
            raise typer.Exit(INTERRUPTED) from None

    def _add_plugins(self) -> None:
        for name, entry in registry.entries(COMMANDS).items():
            self.commands.setdefault(name, PluginCommand(entry))


def _plain(error: typer.BadParameter) -> str:
    """What is wrong with a value, and which one, without the words of the library that found it."""
    from pydantic import ValidationError

    message = error.message.removeprefix("Value error, ").replace("Input should be", "must be")
    message = message.partition(", unable to parse")[0]
    cause = error.__cause__
    if not isinstance(cause, ValidationError):
        return message
    found = cause.errors()[0]["input"]
    return message if repr(found) in message else f"{message}; found {found!r}"


class PluginCommand(TyperCommand):
    """Stands for a command of a plugin until it is called."""

    def __init__(self, entry: registry.Entry) -> None:
        super().__init__(entry.name, callback=None, short_help=summary(entry))

    @override
    def make_context(
        self, info_name: str | None, args: list[str], parent: "Context | None" = None, **extra: Any
    ) -> "Context":
        """The context of the command itself, which is imported here.

        Raises:
            UserError: Several packages offer the name, or the command cannot be imported.
        """
        found = load_command(registry.find(COMMANDS, str(self.name)))
        own = as_group_member(found, str(self.name))
        return own.make_context(info_name, args, parent, **extra)

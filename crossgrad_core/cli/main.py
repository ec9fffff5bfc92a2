"""The command `crossgrad`."""

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command
from typing_extensions import override

from crossgrad_core.cli import run, trained
from crossgrad_core.cli.streams import outlast_readers
from crossgrad_core.defaults import EXAMPLE_OPERATOR, GROUP_SAMPLER
from crossgrad_core.errors import UserError
from crossgrad_core.registry import entries as registry
from crossgrad_core.registry.commands import as_group_member, load_command, summary
from crossgrad_core.registry.entries import failed_plugin, notes_on
from crossgrad_core.registry.slots import COMMANDS
from crossgrad_core.system.command_options import GroupedCommand
from crossgrad_core.system.files import is_too_long, path_too_long
from crossgrad_core.system.startup import finish
from crossgrad_core.system.version import VERSION

if TYPE_CHECKING:
    from typer._click import Command, Context


#: Exit status after an interrupt from the keyboard: 128 + SIGINT.
INTERRUPTED = 130


class WithPlugins(TyperGroup):
    """A group of the core's commands and of the commands of installed plugins.

    The group searches the plugin packages only if the core does not contain the command. A plugin
    cannot replace a command of the core.
    """

    @override
    def get_command(self, ctx: "Context", cmd_name: str) -> "Command | None":
        """Return the command `cmd_name` of the core or of a plugin; None if it is unknown."""
        if cmd_name not in self.commands:
            self._add_plugins()
        return super().get_command(ctx, cmd_name)

    @override
    def list_commands(self, ctx: "Context") -> list[str]:
        """Return the names of all commands."""
        self._add_plugins()
        return super().list_commands(ctx)

    @override
    def invoke(self, ctx: "Context") -> object:
        """Run a command; after Ctrl+C, exit with status 130, as shells expect."""
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
    """Return the message about a wrong option value, without pydantic's phrases."""
    from pydantic import ValidationError

    message = error.message.removeprefix("Value error, ").replace("Input should be", "must be")
    message = message.partition(", unable to parse")[0]
    cause = error.__cause__
    if not isinstance(cause, ValidationError):
        return message
    value = cause.errors()[0]["input"]
    return message if repr(value) in message else f"{message}; found {value!r}"


class PluginCommand(TyperCommand):
    """A placeholder that imports a plugin's command only when a user calls the command."""

    def __init__(self, entry: registry.Entry) -> None:
        super().__init__(entry.name, callback=None, short_help=summary(entry))

    @override
    def make_context(
        self, info_name: str | None, args: list[str], parent: "Context | None" = None, **extra: Any
    ) -> "Context":
        """Import the plugin's command and return the context of the command.

        Raises:
            UserError: Several packages define a command of this name, or the command cannot be
                imported.
        """
        command = load_command(registry.find(COMMANDS, str(self.name)))
        member = as_group_member(command, str(self.name))
        return member.make_context(info_name, args, parent, **extra)


#: Exit status after bad input.
BAD_INPUT = 2
app = typer.Typer(
    name="crossgrad",
    cls=WithPlugins,
    help="Train 3D Gaussian Splatting from photos of hybrid captures, with "
    "exchangeable components.",
    epilog=f"Example: crossgrad run SCENE --sampler {GROUP_SAMPLER} --operator {EXAMPLE_OPERATOR}",
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"crossgrad {VERSION}")
        raise typer.Exit


@app.callback(invoke_without_command=True)
def crossgrad(
    context: typer.Context,
    _version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version and exit."
        ),
    ] = False,
) -> None:
    """Train 3D Gaussian Splatting from hybrid captures, with exchangeable components."""
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


app.command("run", cls=GroupedCommand)(run.run)
app.command("eval", cls=GroupedCommand)(trained.evaluate)
app.command("render", cls=GroupedCommand)(trained.render)
app.command("export", cls=GroupedCommand)(trained.export)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; for bad input, print one message and exit with status 2.

    Args:
        arguments: The words after `crossgrad`; `sys.argv[1:]` by default.
    """
    # The program `crossgrad` calls this function without arguments. A Python caller passes
    # arguments, and its standard streams must not change.
    if arguments is None:
        outlast_readers()
    try:
        # Do not call `app()`, because it would replace `sys.excepthook`.
        get_command(app)(args=arguments, prog_name="crossgrad")
    except Exception as error:
        user_error = error if isinstance(error, UserError) else failed_plugin(error)
        if user_error is None and isinstance(error, OSError) and is_too_long(error):
            user_error = path_too_long(error.filename)
        if user_error is None:  # This error is a bug of crossgrad, so show its traceback.
            raise
        finish()
        print(f"error: {user_error}", file=sys.stderr)  # noqa: T201
        for note in notes_on(user_error):
            print(f"  {note}", file=sys.stderr)  # noqa: T201
        sys.exit(BAD_INPUT)
    finally:
        finish()

"""The command `crossgrad`."""

import sys
from collections.abc import Sequence
from typing import Annotated

import typer
from typer.main import get_command

from crossgrad_core.cli import evaluate, export, render, run
from crossgrad_core.cli.plugin_commands import WithPlugins
from crossgrad_core.cli.streams import outlast_readers
from crossgrad_core.defaults import EXAMPLE_OPERATOR, GROUP_SAMPLER
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import failed_plugin, notes_on
from crossgrad_core.system.files import is_too_long, path_too_long
from crossgrad_core.system.help_groups import GroupedCommand
from crossgrad_core.system.startup import finish
from crossgrad_core.system.version import VERSION

#: Exit status after bad input.
BAD_INPUT = 2

app = typer.Typer(
    name="crossgrad",
    cls=WithPlugins,
    help="Train 3D Gaussian Splatting from hybrid captures, with exchangeable parts.",
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
    """Train 3D Gaussian Splatting from hybrid captures, with exchangeable parts."""
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


app.command("run", cls=GroupedCommand)(run.run)
app.command("eval", cls=GroupedCommand)(evaluate.evaluate)
app.command("render", cls=GroupedCommand)(render.render)
app.command("export", cls=GroupedCommand)(export.export)


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command line; bad input ends in one message and exit status 2.

    Args:
        arguments: What the user typed after `crossgrad`; `sys.argv[1:]` by default.
    """
    if arguments is None:  # This process is the command's own.
        outlast_readers()
    try:
        # Not `app()`, which would replace `sys.excepthook`.
        get_command(app)(args=arguments, prog_name="crossgrad")
    except Exception as error:
        told = error if isinstance(error, UserError) else failed_plugin(error)
        if told is None and isinstance(error, OSError) and is_too_long(error):
            told = path_too_long(error.filename)
        if told is None:  # Our own mistakes keep their traceback.
            raise
        finish()
        print(f"error: {told}", file=sys.stderr)  # noqa: T201
        for note in notes_on(told):
            print(f"  {note}", file=sys.stderr)  # noqa: T201
        sys.exit(BAD_INPUT)
    finally:
        finish()

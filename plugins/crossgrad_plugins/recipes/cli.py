"""Commands that list recipes and show their decisions."""

from pathlib import Path
from typing import Annotated

import typer

from crossgrad_core.commands import announce, entries

app = typer.Typer(
    help="List the recipes, which decide the settings of a run.",
    rich_markup_mode=None,
    add_completion=False,
    no_args_is_help=False,
)


@app.callback(invoke_without_command=True)
def recipes(context: typer.Context) -> None:
    """List the recipes, which decide the settings of a run."""
    if context.invoked_subcommand is None:
        from crossgrad_core.commands import load_component

        names = list(entries("recipes"))
        width = max(map(len, names), default=0)
        for name in names:
            text = load_component("recipes", name).__doc__ or ""
            typer.echo(f"{name:<{width}}  {text.strip().splitlines()[0] if text else ''}")


@app.command()
def show(
    name: Annotated[str, typer.Argument(help="The recipe.")],
    scene: Annotated[
        Path | None, typer.Argument(help="Scene folder. Default: the bundled scene.")
    ] = None,
    steps: Annotated[int, typer.Option(help="Length of the run, in steps.", min=1)] = 30_000,
) -> None:
    """Show the settings that a recipe decides for a scene and a length; nothing is trained."""
    announce()
    from crossgrad_core.commands import configured, read_scene, table_of
    from crossgrad_core.plugin import table_lines

    given = {"recipe": {"name": name}, "steps": steps}
    config = configured(given if scene is None else {**given, "scene": scene})
    for line in table_lines(tuple(table_of(config, read_scene(config)[0]).values())):
        typer.echo(line)

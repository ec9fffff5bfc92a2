"""`crossgrad sweep`: many runs, resumable, on all cores of a machine or on a cluster."""

from pathlib import Path
from typing import Annotated

import typer

from crossgrad_core.commands import UserError, announce

_WHAT = "What is run"
_WHERE = "Where it is run"
_SHOW = "Without running anything"


def sweep(  # noqa: PLR0913, PLR0917 - one parameter per option of the command line
    grid: Annotated[
        Path,
        typer.Argument(metavar="GRID", help="YAML file with the grid.", show_default=False),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder of the sweep; what is finished there is not repeated. Default: the grid's "
            "name below runs/sweeps/.",
            rich_help_panel=_WHAT,
        ),
    ] = None,
    scene: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="SCENE",
            help="A scene instead of those of the grid, repeatable.",
            rich_help_panel=_WHAT,
        ),
    ] = None,
    seed: Annotated[
        list[int] | None,
        typer.Option(
            min=0,
            metavar="N",
            help="A seed instead of those of the grid, repeatable.",
            rich_help_panel=_WHAT,
        ),
    ] = None,
    assignments: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="A setting of all runs, repeatable; wins over the grid.",
            rich_help_panel=_WHAT,
        ),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            min=1,
            metavar="N",
            help="Runs at a time. Default: as many as there are cores and memory for.",
            rich_help_panel=_WHERE,
        ),
    ] = None,
    threads: Annotated[
        int,
        typer.Option(
            min=1, metavar="N", help="Threads and cores of each run.", rich_help_panel=_WHERE
        ),
    ] = 1,
    memory: Annotated[
        float | None,
        typer.Option(
            min=0.1,
            metavar="GIB",
            help="Memory of each run; one that takes more is stopped. Default: an equal share.",
            rich_help_panel=_WHERE,
        ),
    ] = None,
    engine: Annotated[
        str,
        typer.Option(
            metavar="local|ray|slurm", help="Who carries out the runs.", rich_help_panel=_WHERE
        ),
    ] = "local",
    engine_option: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KEY=VALUE",
            help="An option of the engine, repeatable (docs/sweep.md lists them).",
            rich_help_panel=_WHERE,
        ),
    ] = None,
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run",
            help="Checks everything, lists the runs to do and estimates their time.",
            rich_help_panel=_SHOW,
        ),
    ] = False,
    list_runs: Annotated[
        bool,
        typer.Option("--list", help="Lists all runs and how far they are.", rich_help_panel=_SHOW),
    ] = False,
    best: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Writes a grid with the best parameters of each arm and scene, for other seeds.",
            rich_help_panel=_SHOW,
        ),
    ] = None,
) -> None:
    """Run a grid of configurations, scenes and seeds; resume it after any interruption.

    Every run is one of `crossgrad run` in a folder of its own; its name is a hash of its
    configuration, scene and seed, so that what is finished is never repeated.
    """
    looks = {"--dry-run": dry_run, "--list": list_runs, "--best": best is not None}
    asked = [name for name, given in looks.items() if given]
    if len(asked) > 1:
        raise UserError(
            f"{' and '.join(asked)} do not go together", todo="leave all but one of them out"
        )
    looks_only = bool(asked)
    announce(quiet=looks_only)
    from crossgrad_plugins.sweep.app import Request, Sweep
    from crossgrad_plugins.sweep.engines import ENGINES

    if engine not in ENGINES:
        raise UserError(
            f"there is no engine named {engine!r}",
            where="--engine",
            expected=", ".join(ENGINES),
            todo="leave it out to run on this machine",
        )
    found = Sweep(
        Request(
            path=grid,
            out=out,
            scenes=scene or (),
            seeds=seed or (),
            assignments=assignments or (),
            workers=workers,
            threads=threads,
            memory=memory,
            engine=engine,
            options=[_option(each) for each in engine_option or ()],
        ),
        looks_only=looks_only,
    )
    if list_runs:
        raise typer.Exit(found.tell())
    if best is not None:
        raise typer.Exit(found.write_best(best))
    raise typer.Exit(found.foretell() if dry_run else found.carry_out())


def _option(text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not equals or not key:
        raise UserError(
            "an option of the engine has no value",
            where="--engine-option",
            expected="KEY=VALUE",
            found=repr(text),
            todo="write for example --engine-option address=auto",
        )
    return key.strip(), value.strip()

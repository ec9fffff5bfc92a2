"""`crossgrad sweep`: many runs that can be resumed, on one machine or on a cluster."""

from dataclasses import dataclass
from pathlib import Path

import typer

from crossgrad_core.commands import UserError, announce, argument, command_of, option

_WHAT = "Runs"
_WHERE = "Execution"
_SHOW = "Options that start no run"


@dataclass(frozen=True)
class Options:
    """Options of the command."""

    grid: Path = argument("GRID", "YAML file with the grid.")
    out: Path | None = option(
        None,
        "Folder of the sweep; finished runs in it are not repeated. Default: the "
        "grid's name below runs/sweeps/.",
        "DIR",
        heading=_WHAT,
    )
    scene: list[Path] | None = option(
        None, "A scene that replaces the scenes of the grid. Repeatable.", "SCENE", heading=_WHAT
    )
    seed: list[int] | None = option(
        None, "A seed that replaces the seeds of the grid. Repeatable.", "N", heading=_WHAT, min=0
    )
    assignments: list[str] | None = option(
        None,
        "A setting of all runs, which overrides the grid. Repeatable.",
        "KEY=VALUE",
        heading=_WHAT,
        flag="--set",
    )
    workers: int | None = option(
        None,
        "Number of runs at a time. Default: as many as cores and memory allow.",
        "N",
        heading=_WHERE,
        min=1,
    )
    threads: int = option(1, "Threads and cores of each run.", "N", heading=_WHERE, min=1)
    memory: float | None = option(
        None,
        "Memory of each run; a run that uses more is stopped. Default: an equal share.",
        "GIB",
        heading=_WHERE,
        min=0.1,
    )
    engine: str = option(
        "local", "System that executes the runs.", "local|ray|slurm", heading=_WHERE
    )
    engine_option: list[str] | None = option(
        None,
        "An option of the engine (docs/sweep.md lists them). Repeatable.",
        "KEY=VALUE",
        heading=_WHERE,
    )
    dry_run: bool = option(
        False,
        "Check everything, list the open runs and estimate their time.",
        heading=_SHOW,
        flag="--dry-run",
    )
    list_runs: bool = option(
        False, "List all runs and their progress.", heading=_SHOW, flag="--list"
    )
    best: Path | None = option(
        None,
        "Write a grid with the best parameters of each arm and scene, for other seeds.",
        "FILE",
        heading=_SHOW,
    )


@command_of(Options)
def sweep(given: Options) -> None:
    """Run or resume a grid of configurations, scenes and seeds.

    Every run is executed by `crossgrad run` in a separate folder. The folder is named by a hash of
    configuration, scene and seed, so that a finished run is never repeated.
    """
    looks = {
        "--dry-run": given.dry_run, "--list": given.list_runs, "--best": given.best is not None
    }  # fmt: skip
    asked = [name for name, is_given in looks.items() if is_given]
    if len(asked) > 1:
        raise UserError(f"{' and '.join(asked)} cannot be combined", todo="use only one of them")
    read_only = bool(asked)
    announce(quiet=read_only)
    from crossgrad_plugins.sweep.app import Request, Sweep
    from crossgrad_plugins.sweep.engines import ENGINES

    if given.engine not in ENGINES:
        raise UserError(
            f"the engine {given.engine!r} is unknown",
            where="--engine",
            expected=", ".join(ENGINES),
            todo="leave --engine out to run on this machine",
        )
    this_sweep = Sweep(
        Request(
            path=given.grid,
            out=given.out,
            scenes=given.scene or (),
            seeds=given.seed or (),
            assignments=given.assignments or (),
            workers=given.workers,
            threads=given.threads,
            memory=given.memory,
            engine=given.engine,
            options=[_option(text) for text in given.engine_option or ()],
        ),
        read_only=read_only,
    )
    if given.list_runs:
        raise typer.Exit(this_sweep.tell())
    if given.best is not None:
        raise typer.Exit(this_sweep.write_best(given.best))
    raise typer.Exit(this_sweep.foretell() if given.dry_run else this_sweep.carry_out())


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

"""`crossgrad diagnose`: regimes, bimodality, gradient conflict and variance split."""

from dataclasses import dataclass, replace
from pathlib import Path

import typer

from crossgrad_core.commands import UserError, announce, argument, command_of, option

_PROBE = "Probe"
_MODEL = "Model"


@dataclass(frozen=True)
class Given:
    """The options of the command."""

    scene: Path | None = argument(
        "SCENE",
        "Scene folder. Default: the bundled example scene, or the scene of --run.",
        default=None,
    )
    run: Path | None = option(
        None,
        "Probe this finished or stopped run instead of a short vanilla run.",
        "RUN",
        heading=_MODEL,
    )
    accept_scene: bool = option(
        False,
        "With --run: continue although photos, masks, points or held-out views have changed.",
        heading=_MODEL,
        flag="--accept-scene",
    )
    seconds: float | None = option(
        None,
        "Training seconds of the vanilla run. Default: 60.",
        "S",
        heading=_MODEL,
        min=1.0,
    )
    max_size: int | None = option(
        None, "Longest image side; larger photos are resized.", "PIXELS", heading=_MODEL
    )
    seed: int = option(0, "Seed of the vanilla run and of the probes.", "N", heading=_MODEL, min=0)
    grouping: str | None = option(
        None,
        "Grouping into near and far views. Default: the grouping of --run, or else radial.",
        "NAME",
        heading=_PROBE,
    )
    views: int = option(
        12, "Maximum number of probed training views of each group.", "N", heading=_PROBE, min=2
    )
    probes: int | None = option(
        None,
        "Number of probes during the vanilla run, including one at its end. Default: 4.",
        "N",
        heading=_PROBE,
        min=1,
    )
    signature: Path | None = option(
        None,
        "Write the labels of grouping conflict-signature to this CSV file, for --grouping lists.",
        "FILE",
        heading=_PROBE,
    )
    out: Path | None = option(
        None,
        "Folder for the CSV files and the figure. Default: a folder below "
        "runs/SCENE/diagnose, or RUN/diagnose.",
        "DIR",
    )
    device: str | None = option(
        None,
        "Device of the tensors. Default: auto, or the device of --run.",
        "auto|cpu|cuda|cuda:N",
    )
    threads: int | None = option(None, "Number of CPU threads. Default: all.", "N")


@command_of(Given)
def diagnose(given: Given) -> None:
    """Measure camera regimes, gradient conflict and gradient variance.

    Trains a short vanilla run, or uses the run of --run. Then it measures the gradients of single
    views at fixed parameters, and writes CSV files and a figure. The variance is split into the
    part within groups of views and the part between groups.
    """
    vanilla = {
        "--seconds": given.seconds, "--max-size": given.max_size, "--probes": given.probes
    }  # fmt: skip
    idle = {"--accept-scene": given.accept_scene or None} if given.run is None else vanilla
    _refuse_idle([name for name, value in idle.items() if value is not None], given.run)
    announce()
    from crossgrad_core.commands import ComponentChoice
    from crossgrad_plugins.diagnostics import app
    from crossgrad_plugins.diagnostics.app import Options

    options = Options(
        grouping=None if given.grouping is None else ComponentChoice(name=given.grouping),
        per_group=given.views,
        seed=given.seed,
        signature=given.signature,
    )
    options = replace(
        options,
        probes=options.probes if given.probes is None else given.probes,
        seconds=options.seconds if given.seconds is None else given.seconds,
    )
    wanted = {
        "device": given.device,
        "threads": given.threads,
        "data": None if given.max_size is None else {"max_size": given.max_size},
    }
    settings = {name: value for name, value in wanted.items() if value is not None}
    raise typer.Exit(
        app.diagnose(given.scene, given.run, settings, options, given.out, given.accept_scene)
    )


def _refuse_idle(idle: list[str], run: Path | None) -> None:
    """Refuse options that have no effect in this diagnosis."""
    if idle:
        why = (
            "without --run" if run is None else "with --run: a run is probed once, without training"
        )
        raise UserError(f"{' and '.join(idle)} has no effect {why}", todo="leave it out")

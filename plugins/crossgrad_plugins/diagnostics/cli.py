"""`crossgrad diagnose`: regimes, bimodality, gradient conflict, variance split."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from crossgrad_core.commands import UserError, announce

_PROBE = "Probe"
_MODEL = "Model"


def diagnose(  # noqa: PLR0913, PLR0917 - one parameter per option of the command line
    scene: Annotated[
        Path | None,
        typer.Argument(
            metavar="SCENE",
            help="Scene folder. Default: the bundled example scene, or the one of --run.",
            show_default=False,
        ),
    ] = None,
    run: Annotated[
        Path | None,
        typer.Option(
            metavar="RUN",
            help="Probe this finished or stopped run instead of a short vanilla run.",
            rich_help_panel=_MODEL,
        ),
    ] = None,
    accept_scene: Annotated[
        bool,
        typer.Option(
            "--accept-scene",
            help="With --run: take the scene although photos, masks, points or held-out views have "
            "changed.",
            rich_help_panel=_MODEL,
        ),
    ] = False,
    seconds: Annotated[
        float | None,
        typer.Option(
            min=1.0,
            metavar="S",
            help="Training seconds of the vanilla run. Default: 60.",
            rich_help_panel=_MODEL,
        ),
    ] = None,
    max_size: Annotated[
        int | None,
        typer.Option(
            metavar="PIXELS",
            help="Longest image side; larger photos are resized.",
            rich_help_panel=_MODEL,
        ),
    ] = None,
    seed: Annotated[
        int,
        typer.Option(
            min=0,
            metavar="N",
            help="Seed of the vanilla run and of the probes.",
            rich_help_panel=_MODEL,
        ),
    ] = 0,
    grouping: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Which views are near and far. Default: the grouping of --run, or else radial.",
            rich_help_panel=_PROBE,
        ),
    ] = None,
    views: Annotated[
        int,
        typer.Option(
            min=2,
            metavar="N",
            help="Probed training views of each group, at most.",
            rich_help_panel=_PROBE,
        ),
    ] = 12,
    probes: Annotated[
        int | None,
        typer.Option(
            min=1,
            metavar="N",
            help="Probes during the vanilla run; the last one is at its end. Default: 4.",
            rich_help_panel=_PROBE,
        ),
    ] = None,
    signature: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Write the labels of grouping conflict-signature to this CSV file, "
            "for --grouping lists.",
            rich_help_panel=_PROBE,
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder for the CSV files and the picture. Default: below runs/SCENE/diagnose, or "
            "RUN/diagnose.",
        ),
    ] = None,
    device: Annotated[
        str | None,
        typer.Option(
            metavar="auto|cpu|cuda|cuda:N",
            help="Where tensors live. Default: auto, or the device of --run.",
        ),
    ] = None,
    threads: Annotated[
        int | None, typer.Option(metavar="N", help="CPU threads. Default: all there are.")
    ] = None,
) -> None:
    """Measure a scene: camera regimes, gradient conflict, variance.

    Trains a short vanilla run (or takes --run), probes the gradients of single views at frozen
    parameters, and writes CSV files and a picture. The variance is split into the part within
    groups of views and the part between them.
    """
    vanilla = {"--seconds": seconds, "--max-size": max_size, "--probes": probes}
    idle = {"--accept-scene": accept_scene or None} if run is None else vanilla
    _refuse_idle([name for name, value in idle.items() if value is not None], run)
    announce()
    from crossgrad_core.commands import ComponentChoice
    from crossgrad_plugins.diagnostics import app
    from crossgrad_plugins.diagnostics.command import Options

    options = Options(
        grouping=None if grouping is None else ComponentChoice(name=grouping),
        per_group=views,
        seed=seed,
        signature=signature,
    )
    options = replace(
        options,
        probes=options.probes if probes is None else probes,
        seconds=options.seconds if seconds is None else seconds,
    )
    given = {
        "device": device,
        "threads": threads,
        "reading": None if max_size is None else {"max_size": max_size},
    }
    settings = {name: value for name, value in given.items() if value is not None}
    raise typer.Exit(app.diagnose(scene, run, settings, options, out, accept_scene))


def _refuse_idle(idle: list[str], run: Path | None) -> None:
    """Refuses options that do nothing for what is diagnosed."""
    if idle:
        why = "without --run" if run is None else "with --run: a run is probed once, as it is"
        raise UserError(f"{' and '.join(idle)} does nothing {why}", todo="leave it out")

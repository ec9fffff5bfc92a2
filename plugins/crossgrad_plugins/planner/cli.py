"""`crossgrad plan`: what a scene needs, and what it does not, before a run."""

from pathlib import Path
from typing import Annotated

import typer

from crossgrad_core.commands import announce

_RUN = "Run (what you set here is not decided)"
_RESULTS = "Results"


def plan(  # noqa: PLR0913, PLR0917 - one parameter per option of the command line
    scene: Annotated[
        Path | None,
        typer.Argument(
            metavar="SCENE",
            help="Scene folder. Default: the bundled example scene.",
            show_default=False,
        ),
    ] = None,
    probe: Annotated[
        float | None,
        typer.Option(
            "--probe",
            min=1.0,
            metavar="SECONDS",
            help="Also train so many seconds and measure gradients: noise scale, variance between "
            "near and far, conflict.",
        ),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(
            "--config",
            metavar="FILE",
            help="YAML file with settings of the run.",
            rich_help_panel=_RUN,
        ),
    ] = None,
    assignments: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="One setting of the run, repeatable: exposure=none, backbone.sh_degree=3.",
            rich_help_panel=_RUN,
        ),
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(
            min=0.0, metavar="S", help="Training seconds of the run.", rich_help_panel=_RUN
        ),
    ] = None,
    steps: Annotated[
        int | None,
        typer.Option(min=1, metavar="N", help="Steps of the run.", rich_help_panel=_RUN),
    ] = None,
    max_size: Annotated[
        int | None,
        typer.Option(
            metavar="PIXELS",
            help="Longest image side; larger photos are resized.",
            rich_help_panel=_RUN,
        ),
    ] = None,
    device: Annotated[
        str | None,
        typer.Option(
            metavar="auto|cpu|cuda|cuda:N",
            help="Where tensors live. Default: auto.",
            rich_help_panel=_RUN,
        ),
    ] = None,
    threads: Annotated[
        int | None,
        typer.Option(
            metavar="N", help="CPU threads. Default: all there are.", rich_help_panel=_RUN
        ),
    ] = None,
    as_json: Annotated[
        bool,
        typer.Option("--json", help="Print JSON, with all figures.", rich_help_panel=_RESULTS),
    ] = False,
    write: Annotated[
        Path | None,
        typer.Option(
            "--write",
            metavar="FILE",
            help="Write the settings to this file, for `crossgrad run --config FILE`.",
            rich_help_panel=_RESULTS,
        ),
    ] = None,
) -> None:
    """Decide on evidence what a run on a scene needs.

    Looks at cameras, photos, SfM points and tracks; trains nothing without --probe. Each part
    stands in a table with the decision, the figure it rests on, what it saves, and the option that
    overrules it. Where evidence is missing the default stays. `crossgrad run --plan auto` decides
    likewise and trains; `--plan turns` only decides how often far and near views come.
    """
    announce(quiet=as_json)
    from crossgrad_plugins.planner import app

    options = {
        "scene": None if scene is None else str(scene),
        "seconds": seconds,
        "steps": steps,
        "max_size": max_size,
        "device": device,
        "threads": threads,
    }
    made, way = app.plan(config, options, assignments or [], probe, write)
    app.show(made, way, as_json=as_json)

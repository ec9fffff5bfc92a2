"""`crossgrad run`: train, evaluate, export."""

from pathlib import Path
from typing import Annotated

import typer

from crossgrad_core.cli.resuming import refuse_beside_resume
from crossgrad_core.defaults import BACKBONE, EXAMPLE_CHAIN, OPERATOR, SAMPLER
from crossgrad_core.system.startup import announce

_PARTS = "Components (`crossgrad plugins list` shows the names)"
_TRAINING = "Training"
_SCENE = "Scene"
_MACHINE = "Machine"
_RESULTS = "Results"
_CONFIGURATION = "Configuration"


def run(  # noqa: PLR0913, PLR0917 - one parameter per option of the command line
    scene: Annotated[
        Path | None,
        typer.Argument(
            metavar="SCENE",
            help="Scene folder (COLMAP: images/ and sparse/). Default: the bundled example scene.",
            show_default=False,
        ),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(
            "--config",
            metavar="FILE",
            help="YAML file with settings, such as the config.yaml of a run. Options given here "
            "win over the file.",
            rich_help_panel=_CONFIGURATION,
        ),
    ] = None,
    assignments: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="One setting, repeatable: operator.c=0.4, rasterizer.max_alpha=0.999. Wins over "
            "everything else.",
            rich_help_panel=_CONFIGURATION,
        ),
    ] = None,
    preset: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Training rules: default, or inria (order of a step, 3-sigma footprint and near "
            "plane of the original code).",
            rich_help_panel=_CONFIGURATION,
        ),
    ] = None,
    backbone: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help=f"What is trained. Default: {BACKBONE}.",
            rich_help_panel=_PARTS,
        ),
    ] = None,
    sampler: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help=f"Which views a step renders. Default: {SAMPLER} (two views).",
            rich_help_panel=_PARTS,
        ),
    ] = None,
    grouping: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="How views are labelled near or far. Default: what the sampler needs.",
            rich_help_panel=_PARTS,
        ),
    ] = None,
    operator: Annotated[
        str | None,
        typer.Option(
            metavar="NAME[+NAME]",
            help="How the views' gradients become one; a chain is written "
            f"{EXAMPLE_CHAIN}. Default: {OPERATOR}.",
            rich_help_panel=_PARTS,
        ),
    ] = None,
    densifier: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="How primitives are added and removed; none keeps them. Default: the backbone's.",
            rich_help_panel=_PARTS,
        ),
    ] = None,
    rasterizer: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="What draws. Default: auto, the fastest one for the device.",
            rich_help_panel=_PARTS,
        ),
    ] = None,
    reader: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="What reads the scene. Default: auto, the one that accepts the folder.",
            rich_help_panel=_PARTS,
        ),
    ] = None,
    observe: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Adds an observer, repeatable.",
            rich_help_panel=_PARTS,
        ),
    ] = None,
    views: Annotated[
        int | None,
        typer.Option(
            metavar="K",
            help="Views per step. Default: the sampler's.",
            rich_help_panel=_TRAINING,
        ),
    ] = None,
    steps: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Optimizer steps; every schedule stretches with them.",
            rich_help_panel=_TRAINING,
        ),
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(
            metavar="S",
            help="Training seconds; the number of steps follows the clock.",
            rich_help_panel=_TRAINING,
        ),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Seed of every random number. Default: 0.",
            rich_help_panel=_TRAINING,
        ),
    ] = None,
    schedule: Annotated[
        str | None,
        typer.Option(
            metavar="scaled|absolute",
            help="Stretch the published schedule to the run, or keep its numbers. Default: scaled.",
            rich_help_panel=_TRAINING,
        ),
    ] = None,
    backward: Annotated[
        str | None,
        typer.Option(
            metavar="separate|joint",
            help="One backward pass per view, or one for all views. Default: separate.",
            rich_help_panel=_TRAINING,
        ),
    ] = None,
    background: Annotated[
        str | None,
        typer.Option(
            metavar="COLOR",
            help="black, white, random or r,g,b with numbers from 0 to 1. Default: black.",
            rich_help_panel=_TRAINING,
        ),
    ] = None,
    max_gaussians: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Density control stops growing here. Default: what fits into memory.",
            rich_help_panel=_TRAINING,
        ),
    ] = None,
    max_size: Annotated[
        int | None,
        typer.Option(
            metavar="PIXELS",
            help="Longest image side; larger photos are resized.",
            rich_help_panel=_SCENE,
        ),
    ] = None,
    split: Annotated[
        str | None,
        typer.Option(
            metavar="auto|every|none",
            help="auto: train_list.txt and test_list.txt where present, else every; every: hold "
            "out each n-th image of each folder; none: train on all. Default: auto.",
            rich_help_panel=_SCENE,
        ),
    ] = None,
    test_every: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Each N-th image of a folder, by name, is held out. Default: 8.",
            rich_help_panel=_SCENE,
        ),
    ] = None,
    init: Annotated[
        str | None,
        typer.Option(
            metavar="points|random|PLY",
            help="Where training starts: the scene's points, random ones, or a PLY file. "
            "Default: points.",
            rich_help_panel=_SCENE,
        ),
    ] = None,
    device: Annotated[
        str | None,
        typer.Option(
            metavar="cpu|cuda|cuda:N",
            help="Where tensors live. Default: cpu.",
            rich_help_panel=_MACHINE,
        ),
    ] = None,
    threads: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="CPU threads. Default: all there are.",
            rich_help_panel=_MACHINE,
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Output folder; it must not hold a run. Default: below runs/.",
            rich_help_panel=_RESULTS,
        ),
    ] = None,
    resume: Annotated[
        Path | None,
        typer.Option(
            metavar="RUN",
            help="Continues the stopped run in that folder, bit for bit.",
            rich_help_panel=_RESULTS,
        ),
    ] = None,
    accept_scene: Annotated[
        bool,
        typer.Option(
            "--accept-scene",
            help="With --resume: go on although photos, masks or points of the scene have changed.",
            rich_help_panel=_RESULTS,
        ),
    ] = False,
    eval_every: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Steps between evaluations.",
            rich_help_panel=_RESULTS,
        ),
    ] = None,
    save_every: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Steps between checkpoints.",
            rich_help_panel=_RESULTS,
        ),
    ] = None,
    stop_after: Annotated[
        int | None,
        typer.Option(
            metavar="STEP",
            help="Stops after this step with a checkpoint; --resume continues.",
            rich_help_panel=_RESULTS,
        ),
    ] = None,
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run",
            help="Checks everything and prints the resolved settings; trains nothing.",
            rich_help_panel=_RESULTS,
        ),
    ] = False,
    quiet: Annotated[
        bool,
        typer.Option(
            "--quiet", "-q", help="Prints errors and the result only.", rich_help_panel=_RESULTS
        ),
    ] = False,
    verbose: Annotated[
        bool,
        typer.Option(
            "--verbose", "-v", help="Prints every decision and event.", rich_help_panel=_RESULTS
        ),
    ] = False,
) -> None:
    """Train on a scene, evaluate, and write the results to a folder.

    Every setting has a default; what a run decided is written to its config.yaml, and
    `crossgrad run --config config.yaml` repeats it.
    """
    given = dict(locals())
    announce(quiet=quiet)
    if resume is not None:
        refuse_beside_resume(resume, given)
    from crossgrad_core.run.settings import merged

    of_the_command = (
        "config",
        "assignments",
        "resume",
        "accept_scene",
        "dry_run",
        "quiet",
        "verbose",
    )
    for name in of_the_command:
        del given[name]
    settings = merged(config, given, assignments or [])

    from crossgrad_core.run import app

    code = app.run(
        settings,
        resume=resume,
        dry_run=dry_run,
        verbosity=int(verbose) - int(quiet),
        accept_scene=accept_scene,
    )
    raise typer.Exit(code)

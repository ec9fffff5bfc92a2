"""`crossgrad render`: pictures of a run's views."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from crossgrad_core.cli.of_a_run import AcceptScene, Device, RunFolder, Threads
from crossgrad_core.system.startup import announce


class Split(StrEnum):
    """Which views are drawn."""

    TEST = "test"
    TRAIN = "train"
    ALL = "all"


def render(  # noqa: PLR0913, PLR0917 - one parameter per option of the command line
    run: RunFolder,
    split: Annotated[Split, typer.Option(help="Which views are drawn.")] = Split.TEST,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Where the PNG files go. Default: RUN/renders/<step>."),
    ] = None,
    on: Annotated[
        Path | None,
        typer.Option(
            metavar="SCENE", help="Draw the views of another capture of the place, as eval does."
        ),
    ] = None,
    path: Annotated[
        str | None,
        typer.Option(
            metavar="FILE|ladder",
            help="Draw a film instead: along the cameras of a file, or from the farthest photos "
            "down to the nearest.",
        ),
    ] = None,
    frames: Annotated[
        int, typer.Option(metavar="N", min=2, help="Frames of a ladder. Default: 120.")
    ] = 120,
    device: Device = None,
    threads: Threads = None,
    accept_scene: AcceptScene = False,
) -> None:
    """Draw the views of a run as PNG files."""
    announce()
    from crossgrad_core.run import afterwards

    how = afterwards.How(device, threads, accept_scene)
    if path is not None:
        afterwards.fly(run, path, frames=frames, out=out, how=how)
        return
    afterwards.render(run, split=split.value, out=out, how=how, on=on)

"""`crossgrad render`: pictures of a run's views."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from crossgrad_core.system.startup import announce


class Split(StrEnum):
    """Which views are drawn."""

    TEST = "test"
    TRAIN = "train"
    ALL = "all"


def render(
    run: Annotated[
        Path, typer.Argument(metavar="RUN", help="Folder of a finished or stopped run.")
    ],
    split: Annotated[Split, typer.Option(help="Which views are drawn.")] = Split.TEST,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Where the PNG files go. Default: RUN/renders/<step>."),
    ] = None,
    device: Annotated[
        str | None,
        typer.Option(metavar="cpu|cuda|cuda:N", help="Where tensors live. Default: the run's."),
    ] = None,
    threads: Annotated[
        int | None, typer.Option(metavar="N", help="CPU threads. Default: all there are.")
    ] = None,
    accept_scene: Annotated[
        bool,
        typer.Option(
            "--accept-scene",
            help="Take the scene although photos, masks, points or held-out views have changed.",
        ),
    ] = False,
) -> None:
    """Draw the views of a run as PNG files."""
    announce()
    from crossgrad_core.run import afterwards

    how = afterwards.How(device, threads, accept_scene)
    afterwards.render(run, split=split.value, out=out, how=how)

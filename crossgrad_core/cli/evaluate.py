"""`crossgrad eval`: figures of a run's held-out views."""

from pathlib import Path
from typing import Annotated

import typer

from crossgrad_core.system.startup import announce


def evaluate(
    run: Annotated[
        Path, typer.Argument(metavar="RUN", help="Folder of a finished or stopped run.")
    ],
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
    """Evaluate the held-out views of a run again."""
    announce()
    from crossgrad_core.run import afterwards

    how = afterwards.How(device, threads, accept_scene)
    afterwards.evaluate(run, how)

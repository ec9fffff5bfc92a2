"""The options of the commands that look at a run: which one, and how it is opened."""

from pathlib import Path
from typing import Annotated

import typer

RunFolder = Annotated[
    Path, typer.Argument(metavar="RUN", help="Folder of a finished or stopped run.")
]
Device = Annotated[
    str | None,
    typer.Option(metavar="auto|cpu|cuda|cuda:N", help="Where tensors live. Default: the run's."),
]
Threads = Annotated[
    int | None, typer.Option(metavar="N", help="CPU threads. Default: all there are.")
]
AcceptScene = Annotated[
    bool,
    typer.Option(
        "--accept-scene",
        help="Take the scene although photos, masks, points or held-out views have changed.",
    ),
]

"""`crossgrad eval`: figures of a run's held-out views."""

from pathlib import Path
from typing import Annotated

import typer

from crossgrad_core.cli.run_options import AcceptScene, Device, RunFolder, Threads
from crossgrad_core.system.startup import announce

Ply = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Evaluate the Gaussians of this PLY instead, drawn on black as viewers draw them.",
    ),
]
On = Annotated[
    Path | None,
    typer.Option(
        metavar="SCENE",
        help="Evaluate on another capture of the place, in the same coordinates: on those of its "
        "views that the run was not trained on.",
    ),
]


def evaluate(
    run: RunFolder,
    ply: Ply = None,
    on: On = None,
    device: Device = None,
    threads: Threads = None,
    accept_scene: AcceptScene = False,
) -> None:
    """Evaluate the held-out views of a run again."""
    announce()
    from crossgrad_core.run.postprocess import evaluate
    from crossgrad_core.run.postprocess.open_options import How

    how = How(device, threads, accept_scene)
    evaluate.evaluate(run, how, ply, on)

"""`crossgrad export`: a run's scene in a file format of other programs."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from crossgrad_core.cli.startup import announce


class Format(StrEnum):
    """File formats."""

    PLY = "ply"


def export(
    run: Annotated[
        Path, typer.Argument(metavar="RUN", help="Folder of a finished or stopped run.")
    ],
    file_format: Annotated[
        Format, typer.Option("--format", help="File format; ply is the usual 3DGS file.")
    ] = Format.PLY,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="The file to write. Default: RUN/point_cloud.ply."),
    ] = None,
    camera: Annotated[
        str | None,
        typer.Option(
            metavar="VIEW",
            help="Bake what depends on the view for this one. Default: mean of the training views.",
        ),
    ] = None,
) -> None:
    """Write the trained scene to a file that viewers open."""
    announce()
    from crossgrad_core import app

    app.export(run, file_format=file_format.value, out=out, camera=camera)

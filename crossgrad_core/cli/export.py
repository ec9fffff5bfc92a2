"""`crossgrad export`: a run's scene in a file format of other programs."""

from pathlib import Path
from typing import Annotated

import typer

from crossgrad_core.cli.run_options import AcceptScene, Device, RunFolder, Threads
from crossgrad_core.system.startup import announce


def export(  # noqa: PLR0913, PLR0917 - one parameter per option of the command line
    run: RunFolder,
    file_format: Annotated[
        str | None,
        typer.Option(
            "--format",
            metavar="NAME",
            help="File format, an exporter; ply is the usual 3DGS file. Default: the run's.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="The file to write. Default: RUN/point_cloud.ply."),
    ] = None,
    camera: Annotated[
        str | None,
        typer.Option(
            metavar="VIEW",
            help="Bake what depends on the view for this one, into RUN/point_cloud_VIEW.ply. "
            "Default: mean of the training views.",
        ),
    ] = None,
    coordinates: Annotated[
        str,
        typer.Option(
            metavar="input|local|enu|utm|epsg:N",
            help="Coordinates of the file: the scene's, those that are trained in, metres east, "
            "north and up, or projected ones; others than input go into "
            "RUN/point_cloud_COORDINATES.ply.",
        ),
    ] = "input",
    device: Device = None,
    threads: Threads = None,
    accept_scene: AcceptScene = False,
) -> None:
    """Write the trained scene to a file that viewers open."""
    announce()
    from crossgrad_core.run.postprocess import export
    from crossgrad_core.run.postprocess.open_options import How

    how = How(device, threads, accept_scene)
    export.export(
        run, file_format=file_format, out=out, camera=camera, coordinates=coordinates, how=how
    )

"""The commands that work on a trained run: `crossgrad eval`, `export` and `render`."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from crossgrad_core.errors import UserError
from crossgrad_core.system.startup import announce

File = Annotated[
    Path | None,
    typer.Option(
        "--file",
        metavar="FILE",
        help="Use the Gaussians of this file (PLY, SPZ, SOG, GLB, splat) instead of the run's. The "
        "background is black, as in viewers.",
    ),
]
Viewer = Annotated[
    str | None,
    typer.Option(
        "--as",
        metavar="playcanvas|mkkellogg|spark|cesium",
        help="Draw the Gaussians of --file by the rules of this viewer.",
    ),
]
On = Annotated[
    Path | None,
    typer.Option(
        metavar="SCENE",
        help="Evaluate on another capture of the same place, in the same coordinates. "
        "Views that the run was trained on are left out.",
    ),
]
RunFolder = Annotated[
    Path, typer.Argument(metavar="RUN", help="Folder of a finished or stopped run.")
]
Device = Annotated[
    str | None,
    typer.Option(
        metavar="auto|cpu|cuda|cuda:N",
        help="Device of the tensors. Default: the device of the run.",
    ),
]
Threads = Annotated[
    int | None, typer.Option(metavar="N", help="Number of CPU threads. Default: all.")
]
AcceptScene = Annotated[
    bool,
    typer.Option(
        "--accept-scene",
        help="Continue although photos, masks, points or held-out views of the scene have changed.",
    ),
]


def evaluate(  # noqa: PLR0913, PLR0917 - one parameter per option of the command line
    run: RunFolder,
    file: File = None,
    viewer: Viewer = None,
    on: On = None,
    device: Device = None,
    threads: Threads = None,
    accept_scene: AcceptScene = False,
) -> None:
    """Evaluate the held-out views of a run again."""
    _check_viewer(file, viewer)
    announce()
    from crossgrad_core.run.postprocess import evaluate
    from crossgrad_core.run.postprocess.drawn_file import DrawnFile
    from crossgrad_core.run.postprocess.open_options import How

    how = How(device, threads, accept_scene)
    evaluate.evaluate(run, how, None if file is None else DrawnFile(file, viewer), on)


def _check_viewer(file: Path | None, viewer: str | None) -> None:
    """Refuse the rules of a viewer for the run's own model, which no viewer draws."""
    if viewer is not None and file is None:
        raise UserError(
            "--as has no effect without --file",
            where=f"--as {viewer}",
            todo="add --file with an exported file, such as RUN/point_cloud.ply",
        )


class UpAxis(StrEnum):
    """The axis of an exported file that points up."""

    Y = "y"
    Z = "z"
    INPUT = "input"


def export(  # noqa: PLR0913, PLR0917 - one parameter per option of the command line
    run: RunFolder,
    file_format: Annotated[
        str | None,
        typer.Option(
            "--format",
            metavar="NAME",
            help="Format of the file, the name of an exporter: `crossgrad plugins list` shows all. "
            "Default: the exporter of the run.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="The output file. Default: RUN/point_cloud.FORMAT."),
    ] = None,
    camera: Annotated[
        str | None,
        typer.Option(
            metavar="VIEW",
            help="Bake view-dependent values for this view. "
            "Default: the mean of the training views.",
        ),
    ] = None,
    coordinates: Annotated[
        str | None,
        typer.Option(
            metavar="input|local|enu|utm|epsg:N",
            help="Coordinates of the file: those of the scene files, those of the training, "
            "metres east, north and up, or projected coordinates. Default: input, for 3D Tiles "
            "enu.",
        ),
    ] = None,
    up: Annotated[
        UpAxis | None,
        typer.Option(
            help="Rotate the scene so that this axis points up; input keeps the axes. Default: y "
            "or z for formats that define it, else input.",
        ),
    ] = None,
    sh_degree: Annotated[
        int | None,
        typer.Option(
            metavar="N", min=0, max=3, help="Highest degree of spherical harmonics. Default: all."
        ),
    ] = None,
    crop: Annotated[
        str | None,
        typer.Option(
            metavar="BOX|FILE",
            help="Export only a part: xmin,ymin,zmin,xmax,ymax,zmax, or a file with one corner "
            "x,y of a polygon per line, in the coordinates of the exported file.",
        ),
    ] = None,
    max_gaussians: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            min=1,
            help="Keep the N Gaussians that contribute most to the training photos.",
        ),
    ] = None,
    unbaked: Annotated[
        bool,
        typer.Option(
            "--unbaked",
            help="Store antialiased Gaussians (backbone mip) with the flag of the format, for "
            "viewers that draw them.",
        ),
    ] = False,
    device: Device = None,
    threads: Threads = None,
    accept_scene: AcceptScene = False,
) -> None:
    """Write the trained scene to a file for viewers."""
    announce()
    from crossgrad_core.run.export import ExportOptions
    from crossgrad_core.run.export_edits import Crop
    from crossgrad_core.run.postprocess import export
    from crossgrad_core.run.postprocess.open_options import How

    options = ExportOptions(
        camera=camera,
        coordinates=coordinates,
        up=up,
        sh_degree=sh_degree,
        crop=None if crop is None else Crop.parsed(crop),
        max_gaussians=max_gaussians,
        baked=not unbaked,
    )
    how = How(device, threads, accept_scene)
    export.export(run, file_format=file_format, out=out, options=options, how=how)


class Split(StrEnum):
    """The set of views to render."""

    TEST = "test"
    TRAIN = "train"
    ALL = "all"


def render(  # noqa: PLR0913, PLR0917 - one parameter per option of the command line
    run: RunFolder,
    split: Annotated[Split | None, typer.Option(help="Views to render. Default: test.")] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", help="Output folder of the PNG files. Default: RUN/renders/<step>."
        ),
    ] = None,
    on: Annotated[
        Path | None,
        typer.Option(
            metavar="SCENE",
            help="Render the views of another capture of the same place, as `crossgrad eval --on` "
            "does.",
        ),
    ] = None,
    path: Annotated[
        str | None,
        typer.Option(
            metavar="FILE|zoom",
            help="Render a video along the camera path in a file, or a zoom from the farthest to "
            "the nearest photos.",
        ),
    ] = None,
    frames: Annotated[
        int | None,
        typer.Option(
            metavar="N", min=2, max=100_000, help="Number of frames of a zoom path. Default: 120."
        ),
    ] = None,
    evolution: Annotated[
        bool,
        typer.Option(
            "--evolution",
            help="Render a video of the first held-out view at each kept checkpoint "
            "(`crossgrad run --save-every N` keeps them).",
        ),
    ] = False,
    file: File = None,
    viewer: Viewer = None,
    device: Device = None,
    threads: Threads = None,
    accept_scene: AcceptScene = False,
) -> None:
    """Render the views of a run as PNG files."""
    _check_viewer(file, viewer)
    alone = "a video shows the views of the cameras on its path"
    _check_together(("--on", on), ("--path", path), alone)
    _check_together(("--split", split), ("--path", path), alone)
    _check_together(("--file", file), ("--path", path), "a video shows the model of the run")
    others = {"--split": split, "--on": on, "--path": path, "--file": file}
    for option, value in others.items():
        _check_together(
            (option, value),
            ("--evolution", evolution or None),
            "a video of the training shows the first held-out view",
        )
    _check_together(("--split", split), ("--on", on), "all views of the other capture are rendered")
    if frames is not None and path is None:
        raise UserError(
            "--frames has no effect without --path zoom",
            where="--frames",
            todo="leave out --frames, or add --path zoom",
        )
    announce()
    from crossgrad_core.run.postprocess import render
    from crossgrad_core.run.postprocess.drawn_file import DrawnFile
    from crossgrad_core.run.postprocess.open_options import How

    how = How(device, threads, accept_scene)
    if path is not None:
        render.render_path(run, path, frames=frames, out=out, how=how)
    elif evolution:
        render.render_evolution(run, out=out, how=how)
    else:
        drawn = None if file is None else DrawnFile(file, viewer)
        render.render(run, split=split or "test", out=out, how=how, on=on, file=drawn)


def _check_together(option: tuple[str, object], other: tuple[str, object], why: str) -> None:
    """Refuse an option that would have no effect together with another option."""
    if option[1] is not None and other[1] is not None:
        raise UserError(
            f"{option[0]} has no effect together with {other[0]}: {why}",
            where=option[0],
            todo=f"leave out {option[0]}, or {other[0]}",
        )

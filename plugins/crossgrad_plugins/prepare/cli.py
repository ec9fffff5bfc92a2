"""The command `crossgrad prepare`."""

from pathlib import Path
from typing import Annotated, Any, Final

import typer

from crossgrad_core.commands import UserError, announce

_HOW = "How cameras are found"
_COSTS = "What it may take"
_CHOICES: Final[dict[str, tuple[str, ...]]] = {
    "features": ("sift",),
    "matching": ("auto", "exhaustive", "spatial", "retrieval", "sequential"),
    "mapper": ("auto", "incremental", "global"),
    "cameras": ("folder", "photo"),
}


def prepare(  # noqa: PLR0913, PLR0917 - one parameter per option of the command line
    photos: Annotated[
        Path,
        typer.Argument(
            metavar="PHOTOS",
            help="Folder of photos; those of different regimes in folders of their own.",
            show_default=False,
        ),
    ],
    scene: Annotated[
        Path,
        typer.Argument(
            metavar="SCENE",
            help="Folder of the scene; the same command goes on there after any interruption.",
            show_default=False,
        ),
    ],
    features: Annotated[
        str, typer.Option(metavar="sift", help="Kind of features.", rich_help_panel=_HOW)
    ] = "sift",
    matching: Annotated[
        str,
        typer.Option(
            metavar="auto|exhaustive|spatial|retrieval|sequential",
            help="Which photos are compared: all, neighbours by GPS, those that look alike, or "
            "neighbours by name. auto decides by the number of photos and their GPS.",
            rich_help_panel=_HOW,
        ),
    ] = "auto",
    mapper: Annotated[
        str,
        typer.Option(
            metavar="auto|incremental|global",
            help="auto is incremental below 100 photos, and below 1000 in several folders.",
            rich_help_panel=_HOW,
        ),
    ] = "auto",
    cameras: Annotated[
        str,
        typer.Option(
            metavar="folder|photo",
            help="Calibrates the photos of a folder together that come from one camera (EXIF), or "
            "each photo by itself.",
            rich_help_panel=_HOW,
        ),
    ] = "folder",
    lens: Annotated[
        str,
        typer.Option(
            metavar="MODEL",
            help="Camera model of COLMAP: OPENCV for wide lenses, OPENCV_FISHEYE for fisheyes.",
            rich_help_panel=_HOW,
        ),
    ] = "SIMPLE_RADIAL",
    masks: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder of masks, black where a pixel does not count. Default: PHOTOS/masks, "
            "masks/ beside photos, NAME_mask.png.",
            rich_help_panel=_HOW,
        ),
    ] = None,
    max_size: Annotated[
        int | None,
        typer.Option(
            min=64,
            metavar="PIXELS",
            help="Longest side of the scene's photos. Default: as they are. Features are found at "
            "3200 pixels at most.",
            rich_help_panel=_COSTS,
        ),
    ] = None,
    max_features: Annotated[
        int,
        typer.Option(
            min=64, metavar="N", help="Features of a photo, at most.", rich_help_panel=_COSTS
        ),
    ] = 8192,
    threads: Annotated[
        int | None,
        typer.Option(
            min=1,
            metavar="N",
            help="CPU threads. Default: all there are; fewer where memory is short.",
            rich_help_panel=_COSTS,
        ),
    ] = None,
) -> None:
    """Find the cameras of a folder of photos: from photos to a scene for `crossgrad run`.

    Features, matches, poses, undistorted photos, place on Earth where photos have GPS, and a report
    (report.md, report.png) of what is in the scene, what is not, and why.
    """
    announce(quiet=True)
    given = {"features": features, "matching": matching, "mapper": mapper, "cameras": cameras}
    for name, value in given.items():
        _check_choice(name, value)
    from crossgrad_plugins.prepare.app import prepare_scene
    from crossgrad_plugins.prepare.plan import Settings

    wanted: dict[str, Any] = {
        **given, "lens": lens.upper(), "max_size": max_size, "max_features": max_features
    }  # fmt: skip
    wanted["masks"] = None if masks is None else str(masks.absolute())
    prepare_scene(photos, scene, Settings(**wanted), threads)


def _check_choice(name: str, value: str) -> None:
    if value not in _CHOICES[name]:
        raise UserError(
            f"there is no such choice of {name}",
            where=f"--{name}",
            expected=" or ".join(_CHOICES[name]),
            found=value,
            todo="leave it out to have it chosen",
        )

"""The command `crossgrad prepare`."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from crossgrad_core.commands import UserError, announce, argument, command_of, option

_HOW = "Pose estimation"
_COSTS = "Limits"
_CHOICES: Final[dict[str, tuple[str, ...]]] = {
    "features": ("sift",),
    "matching": ("auto", "exhaustive", "spatial", "retrieval", "sequential"),
    "mapper": ("auto", "incremental", "global"),
    "cameras": ("folder", "photo"),
}


@dataclass(frozen=True)
class Options:
    """Options of the command."""

    photos: Path = argument(
        "PHOTOS", "Folder of photos; put photos of different regimes into different folders."
    )
    scene: Path = argument(
        "SCENE", "Folder of the scene; after an interruption the same command continues there."
    )
    features: str = option("sift", "Kind of features.", "sift", heading=_HOW)
    matching: str = option(
        "auto",
        "Pairs of photos to match: all, neighbours by GPS, similar photos, or "
        "neighbours by name. auto decides by the number of photos and their GPS.",
        "auto|exhaustive|spatial|retrieval|sequential",
        heading=_HOW,
    )
    mapper: str = option(
        "auto",
        "auto is incremental below 100 photos, and below 1000 photos in several folders.",
        "auto|incremental|global",
        heading=_HOW,
    )
    cameras: str = option(
        "folder",
        "Calibrate all photos of one camera (EXIF) in a folder together, or each photo separately.",
        "folder|photo",
        heading=_HOW,
    )
    lens: str = option(
        "SIMPLE_RADIAL",
        "Camera model of COLMAP: OPENCV for wide-angle lenses, OPENCV_FISHEYE for fisheye lenses.",
        "MODEL",
        heading=_HOW,
    )
    masks: Path | None = option(
        None,
        "Folder of masks, in which black pixels are ignored. Default: PHOTOS/masks, "
        "masks/ next to the photos, NAME_mask.png.",
        "DIR",
        heading=_HOW,
    )
    max_size: int | None = option(
        None,
        "Longest side of the scene's photos. Default: unchanged. Features are "
        "extracted at 3200 pixels at most.",
        "PIXELS",
        heading=_COSTS,
        min=64,
    )
    max_features: int = option(
        8192, "Maximum number of features per photo.", "N", heading=_COSTS, min=64
    )
    threads: int | None = option(
        None,
        "Number of CPU threads. Default: all, or fewer if memory is small.",
        "N",
        heading=_COSTS,
        min=1,
    )


@command_of(Options)
def prepare(given: Options) -> None:
    """Estimate camera poses of photos and make a scene for training.

    The command finds features, matches and poses, and writes undistorted photos. If photos have GPS
    positions, the command also georeferences the scene. A report (report.md, report.png) lists the
    photos in the scene, and the missing photos with reasons.
    """
    announce(quiet=True)
    for name in _CHOICES:
        _check_choice(name, getattr(given, name))
    from crossgrad_plugins.prepare.app import prepare_scene
    from crossgrad_plugins.prepare.plan import Settings

    wanted = {name: value for name, value in asdict(given).items() if name in Settings.model_fields}
    wanted["lens"] = given.lens.upper()
    wanted["masks"] = None if given.masks is None else str(given.masks.absolute())
    prepare_scene(given.photos, given.scene, Settings(**wanted), given.threads)


def _check_choice(name: str, value: str) -> None:
    if value not in _CHOICES[name]:
        raise UserError(
            f"the value of {name} is unknown",
            where=f"--{name}",
            expected=" or ".join(_CHOICES[name]),
            found=value,
            todo="leave the option out to let crossgrad choose",
        )

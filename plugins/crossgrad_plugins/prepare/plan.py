"""The plan: which photos are used, with which settings; what a second start has to agree with."""

from pathlib import Path
from typing import Final

from pydantic import BaseModel, ConfigDict, ValidationError

from crossgrad_core.commands import UserError, write_atomically
from crossgrad_plugins.prepare.layout import Layout

#: Version of the file; raised where an older reader could misread a newer one.
FORMAT: Final = 1


class _Fixed(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Settings(_Fixed):
    """The choices of the user.

    Attributes:
        features: Kind of features.
        matching: Which photos are compared.
        mapper: How poses are found.
        cameras: Which photos share a calibration.
        lens: Camera model of COLMAP.
        masks: Folder of masks; None for those beside the photos.
        max_size: Longest side of the scene's photos in pixels; None as they are.
        max_features: Features of a photo, at most.
    """

    features: str = "sift"
    matching: str = "auto"
    mapper: str = "auto"
    cameras: str = "folder"
    lens: str = "SIMPLE_RADIAL"
    masks: str | None = None
    max_size: int | None = None
    max_features: int = 8192


class Position(_Fixed):
    """A place on Earth: degrees, and metres above whatever the receiver counts from."""

    latitude: float
    longitude: float
    altitude: float


class Photo(_Fixed):
    """A photo that is used.

    Attributes:
        name: Its path below the folder of photos, with forward slashes.
        folder: Its folder; empty for photos that lie in none.
        width: Pixels, as stored.
        height: Likewise.
        orientation: How it is turned when it is shown (EXIF); 1 where it does not say.
        camera: What photos of one calibration share.
        position: Where its GPS says it was taken.
        mask: Path of its mask; None where it has none.
        brightness: Mean of its grey levels, 0 to 255.
        sharpness: Mean square of the Laplacian of its grey levels at a reduced size.
        bytes: Size of the file.
        sha256: Digest of the file.
    """

    name: str
    folder: str
    width: int
    height: int
    orientation: int
    camera: str
    position: Position | None
    mask: str | None
    brightness: float
    sharpness: float
    bytes: int
    sha256: str


class LeftOut(_Fixed):
    """A file that is not used, and why."""

    name: str
    why: str


class Plan(_Fixed):
    """Photos and settings of a scene.

    Attributes:
        format: Version of the file.
        photos: Folder of the photos.
        settings: What the user chose.
        used: The photos that are used, by name.
        left_out: Those that are not.
    """

    format: int = FORMAT
    photos: str
    settings: Settings
    used: tuple[Photo, ...]
    left_out: tuple[LeftOut, ...]

    @property
    def folders(self) -> tuple[str, ...]:
        """The folders of the photos, sorted."""
        return tuple(sorted({photo.folder for photo in self.used}))

    @property
    def located(self) -> tuple[Photo, ...]:
        """The photos with GPS."""
        return tuple(photo for photo in self.used if photo.position is not None)


def agreed(layout: Layout, plan: Plan) -> Plan:
    """The plan of a scene: the one that it has, or this one, which is written down.

    Raises:
        UserError: The scene was begun with other photos or settings, or its plan is damaged.
    """
    if not layout.plan.is_file():
        layout.work.mkdir(parents=True, exist_ok=True)
        write_atomically(layout.plan, plan.model_dump_json(indent=1).encode())
        return plan
    known = read_plan(layout)
    differs = _difference(known, plan)
    if differs:
        raise UserError(
            "the scene was begun otherwise",
            where=layout.scene,
            expected="the same photos and settings",
            found=differs,
            todo="choose another folder for the scene, or remove this one",
        )
    return known


def read_plan(layout: Layout) -> Plan:
    """The plan of a scene.

    Raises:
        UserError: It is damaged, or of a later version.
    """
    try:
        plan = Plan.model_validate_json(layout.plan.read_bytes())
    except (OSError, ValidationError) as error:
        raise UserError(
            "the plan of the scene cannot be read",
            where=layout.plan,
            found=str(error).splitlines()[0],
            todo="remove the scene's folder and prepare it again",
        ) from error
    if plan.format > FORMAT:
        raise UserError(
            "the scene comes from a later version of crossgrad",
            where=layout.plan,
            found=f"format {plan.format}",
            expected=f"at most {FORMAT}",
            todo="update crossgrad",
        )
    return plan


def _difference(known: Plan, plan: Plan) -> str:
    """What tells two plans apart, in words; empty where nothing does."""
    was, now = known.settings.model_dump(), plan.settings.model_dump()
    settings = [f"{key} was {was[key]}, now {now[key]}" for key in was if was[key] != now[key]]
    before = {photo.name: photo.sha256 for photo in known.used}
    after = {photo.name: photo.sha256 for photo in plan.used}
    changed = sorted(name for name, _ in before.items() ^ after.items())
    if changed:
        settings.append(f"photos new, gone or changed: {len(set(changed))}, first {changed[0]}")
    return "; ".join(settings)


def place_of(photos: Path, photo: Photo) -> Path:
    """The file of a photo."""
    return photos / photo.name

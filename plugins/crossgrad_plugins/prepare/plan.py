"""The plan: which photos are used, with which settings; what a second start has to agree with."""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from pydantic import BaseModel, ConfigDict, ValidationError

from crossgrad_core.commands import UserError, write_atomically
from crossgrad_core.scene.wording import count, name_some
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
        mask_sha256: Digest of that file; None in plans of before it was kept.
        transparent: Whether it has pixels with alpha below a half, which do not count.
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
    mask: str | None = None
    mask_sha256: str | None = None
    transparent: bool = False
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
    """The plan that is carried out: this one, which is written down where the scene has no such.

    The same photos may lie in another folder than before, and their masks, too. A scene that is
    ready needs none of them: some may be gone.

    Raises:
        UserError: The scene was begun with other photos or settings, or its plan is damaged.
    """
    known = read_plan(layout) if layout.plan.is_file() else None
    if known is not None:
        _check_same(layout, known, plan)
    if known is not None and layout.is_ready:
        return known
    if known != plan:
        layout.work.mkdir(parents=True, exist_ok=True)
        write_atomically(layout.plan, plan.model_dump_json(indent=1).encode())
    return plan


def _check_same(layout: Layout, known: Plan, plan: Plan) -> None:
    differs = _difference(known, plan, some=layout.is_ready)
    if differs:
        raise UserError(
            "the scene was begun otherwise",
            where=layout.scene,
            expected="the same photos, masks and settings",
            found=differs,
            todo="use those it was begun with, choose another folder for the scene, or remove this "
            "one",
        )


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


def _difference(known: Plan, plan: Plan, *, some: bool) -> str:
    """What tells two plans apart, in words; empty where nothing does.

    Args:
        known: The plan of the scene.
        plan: The plan of now.
        some: Whether some of the photos will do.
    """
    was, now = known.settings.model_dump(), plan.settings.model_dump()
    # Where masks lie does not matter, but what is in them.
    told = [f"{key} was {was[key]}, now {now[key]}" for key in was
            if was[key] != now[key] and key != "masks"]  # fmt: skip
    after = {photo.name: photo for photo in plan.used}
    before = {photo.name: photo for photo in known.used if photo.name in after or not some}
    sums = [{photo.name: photo.sha256 for photo in each.values()} for each in (before, after)]
    told += _changes("photo", *sums)
    both = [(before[name], after[name]) for name in before.keys() & after.keys()]
    new = {photo.name: photo.mask_sha256 for _, photo in both if photo.mask}
    # Plans of before digests were kept have none.
    old = {each.name: each.mask_sha256 or photo.mask_sha256 for each, photo in both
           if each.mask and (photo.mask or not some)}  # fmt: skip
    return "; ".join([*told, *_changes("mask", old, new)])


def _changes(
    noun: str, before: Mapping[str, str | None], after: Mapping[str, str | None]
) -> list[str]:
    """What became of files by their names and digests, in words."""
    kinds = {
        "new": after.keys() - before.keys(),
        "gone": before.keys() - after.keys(),
        "changed": {name for name in before.keys() & after.keys() if before[name] != after[name]},
    }
    return [
        f"{count(len(names), noun)} {what}: {name_some(sorted(names))}"
        for what, names in kinds.items()
        if names
    ]


def digest_of(path: Path) -> str:
    """The digest of a file.

    Raises:
        OSError: It cannot be read.
    """
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()

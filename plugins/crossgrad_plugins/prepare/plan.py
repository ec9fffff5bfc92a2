"""The plan of a scene: photos and settings.

A later call for the scene must have an equal plan.
"""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from pydantic import BaseModel, ConfigDict, ValidationError

from crossgrad_core.commands import UserError, write_atomically
from crossgrad_core.scene.wording import count, name_some
from crossgrad_plugins.prepare.layout import Layout

#: Version of the plan's format. It is increased if older versions of crossgrad could misread the
#: format.
FORMAT: Final = 1


class _Fixed(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Settings(_Fixed):
    """Settings that the user chose.

    Attributes:
        features: Kind of features to find.
        matching: Method that chooses the pairs to compare.
        mapper: Method that estimates poses.
        cameras: Rule that determines which photos have a common calibration.
        lens: COLMAP's name of the camera model.
        masks: Folder of the masks; None to search for masks.
        max_size: Longest side of the undistorted photos in pixels; None keeps their size.
        max_features: Maximum number of features of a photo.
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
    """A GPS position: degrees, and altitude in metres above the reference of the receiver."""

    latitude: float
    longitude: float
    altitude: float


class Photo(_Fixed):
    """A photo that is used.

    Attributes:
        name: Path relative to the folder of photos, with forward slashes.
        folder: Folder of the photo relative to the folder of photos; empty for the top.
        width: Width in pixels, as stored.
        height: Height in pixels, as stored.
        orientation: EXIF orientation, or 1 if it is missing.
        camera: Key of the calibration; photos with equal keys have a common calibration.
        position: GPS position, or None.
        mask: Path of the mask, or None.
        mask_sha256: Digest of the mask, or None in plans of older versions.
        transparent: True if some pixels have an alpha below 0.5; these pixels do not count.
        brightness: Mean of the grey levels, 0 to 255.
        sharpness: Mean squared Laplacian of the grey levels at a reduced size.
        bytes: Size of the file in bytes.
        sha256: SHA-256 digest of the file.
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
    """A file that is not used, with the reason."""

    name: str
    why: str


class Plan(_Fixed):
    """The photos and settings of a scene.

    Attributes:
        format: Version of the format.
        photos: Folder of the photos.
        settings: Settings chosen by the user.
        used: The photos that are used, sorted by name.
        left_out: The files that are not used.
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
    """Return the plan of the scene; write the given plan if the scene has none.

    Photos and masks may be in another folder than in an earlier call. A finished scene does not
    need its photos any more, so some of them may be missing.

    Raises:
        UserError: The scene was started with other photos or settings, or its plan is damaged.
    """
    earlier = read_plan(layout) if layout.plan.is_file() else None
    if earlier is not None:
        _check_same(layout, earlier, plan)
    if earlier is not None and layout.is_ready:
        return earlier
    if earlier != plan:
        layout.work.mkdir(parents=True, exist_ok=True)
        write_atomically(layout.plan, plan.model_dump_json(indent=1).encode())
    return plan


def _check_same(layout: Layout, earlier: Plan, plan: Plan) -> None:
    differs = _difference(earlier, plan, may_lack_photos=layout.is_ready)
    if differs:
        raise UserError(
            "the scene folder was begun with other photos or settings",
            where=layout.scene,
            expected="the same photos, masks and settings",
            found=differs,
            todo="use the original photos and settings, choose another scene folder, or "
            "remove this folder",
        )


def read_plan(layout: Layout) -> Plan:
    """Return the plan of a scene.

    Raises:
        UserError: The plan is damaged, or was written by a later version.
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
            "the scene was prepared by a later version of crossgrad",
            where=layout.plan,
            found=f"format {plan.format}",
            expected=f"at most {FORMAT}",
            todo="update crossgrad",
        )
    return plan


def _difference(earlier: Plan, plan: Plan, *, may_lack_photos: bool) -> str:
    """Describe the differences between two plans. The text is empty for equal plans.

    Args:
        earlier: The stored plan of the scene.
        plan: The new plan.
        may_lack_photos: True if photos of the stored plan may be missing in the new plan.
    """
    was, now = earlier.settings.model_dump(), plan.settings.model_dump()
    # Compare only the contents of masks, not their folder.
    changes = [f"{key} was {was[key]}, now {now[key]}" for key in was
            if was[key] != now[key] and key != "masks"]  # fmt: skip
    after = {photo.name: photo for photo in plan.used}
    before = {
        photo.name: photo for photo in earlier.used if photo.name in after or not may_lack_photos
    }
    sums = [{photo.name: photo.sha256 for photo in photos.values()} for photos in (before, after)]
    changes += _changes("photo", *sums)
    both = [(before[name], after[name]) for name in before.keys() & after.keys()]
    new = {photo.name: photo.mask_sha256 for _, photo in both if photo.mask}
    # Plans of older versions contain no digests of masks.
    old = {old_photo.name: old_photo.mask_sha256 or photo.mask_sha256 for old_photo, photo in both
           if old_photo.mask and (photo.mask or not may_lack_photos)}  # fmt: skip
    return "; ".join([*changes, *_changes("mask", old, new)])


def _changes(
    noun: str, before: Mapping[str, str | None], after: Mapping[str, str | None]
) -> list[str]:
    """Describe new, missing and changed files, found by names and digests."""
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
    """Return the SHA-256 digest of a file.

    Raises:
        OSError: The file cannot be read.
    """
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()

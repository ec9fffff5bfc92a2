"""Compute the fingerprint of a scene, and list the differences between two fingerprints.

A fingerprint contains the local frame, the cameras, the split, a summary of the points, and digests
of files.
"""

import os
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import IntEnum
from hashlib import file_digest, sha256
from pathlib import Path
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from crossgrad_core.contract.scene import Camera, Scene, View
from crossgrad_core.errors import UserError
from crossgrad_core.scene.photos.photos import FilePhoto
from crossgrad_core.scene.split import TEST_LIST, TRAIN_LIST
from crossgrad_core.scene.wording import name_some

#: Version of the format of fingerprints. Increase this number if an older version of crossgrad
#: could misread a newer fingerprint.
FORMAT: Final = 1
#: Number of bytes that are read at the start and at the end of a file.
END = 64 * 2**10
#: Number of stored decimals of values in pixels and in local units. Differences between cameras are
#: much larger than this rounding.
DECIMALS = 6
# Values count as equal within this tolerance, because other machines may round the last digits
# differently.
_TOLERANCE = 10.0 ** (1 - DECIMALS)


class _Mark(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class FileMark(_Mark):
    """The size and digests of a file.

    Attributes:
        bytes: Size of the file in bytes.
        sha256: Digest of the first and the last 64 KiB of the file. Runs of all versions store this
            digest.
        whole: Digest of the complete file. The digest is None if `sha256` already covers the
            complete file, and in fingerprints of earlier versions.
    """

    bytes: int
    sha256: str
    whole: str | None = None

    def differs(self, other: "FileMark | None") -> bool:
        """Return True if `other` describes a file with different content."""
        if other is None:
            return True
        ends = (self.bytes, self.sha256) != (other.bytes, other.sha256)
        return ends or (None not in {self.whole, other.whole} and self.whole != other.whole)


class ViewMark(_Mark):
    """The split, camera and files of a view.

    Attributes:
        trained: True for a training view, False for a held-out view.
        camera: Width, height, fx, fy, cx, cy in pixels, then the centre, right axis and forward
            axis in the local frame.
        photo: File of the photo; None if the photo was not read from a file.
        mask: File of the mask; None without a mask.
    """

    trained: bool
    camera: tuple[float, ...]
    photo: FileMark | None
    mask: FileMark | None


class FrameMark(_Mark):
    """The local frame: its origin in input units, and the number of local units per input unit."""

    offset: tuple[float, float, float]
    scale: Annotated[float, Field(gt=0, allow_inf_nan=False)]


class PointsMark(_Mark):
    """Summary of the SfM points: their number, and mean and deviation of positions and colours."""

    count: int
    moments: tuple[float, ...]


class Fingerprint(_Mark):
    """The fingerprint of a scene, for comparison with later versions of the scene.

    Attributes:
        format: Version of the format.
        frame: The local frame.
        points: Summary of the SfM points.
        lists: Name of a split list -> digest of its file.
        files: Path relative to the scene's folder -> file, for all files that the reader used
            except photos and masks. In fingerprints of earlier versions, `files` is None.
        views: Name of a view -> its split, camera and files.
    """

    format: Literal[1] = FORMAT
    frame: FrameMark
    points: PointsMark
    lists: dict[str, str]
    files: dict[str, FileMark] | None = None
    views: dict[str, ViewMark]


def fingerprint_of(scene: Scene, root: Path) -> Fingerprint:
    """Return the fingerprint of a scene. The function reads all files of the scene.

    Args:
        scene: The scene.
        root: The folder of the scene.

    Raises:
        UserError: A photo or mask cannot be read.
    """
    trained = frozenset(scene.train)
    with ThreadPoolExecutor() as pool:
        files = list(pool.map(_files_of, scene.views))
        others = {os.path.relpath(path, root): mark_of(path) for path in scene.files}
    lists = {name: root / name for name in (TRAIN_LIST, TEST_LIST) if (root / name).is_file()}
    x, y, z = (float(value) for value in scene.similarity.offset)
    return Fingerprint(
        frame=FrameMark(offset=(x, y, z), scale=scene.similarity.scale),
        points=_points_of(scene),
        lists={name: mark_of(path).sha256 for name, path in lists.items()},
        files=others,
        views={
            view.name: ViewMark(
                trained=index in trained, camera=_numbers_of(view.camera), photo=photo, mask=mask
            )
            for index, (view, (photo, mask)) in enumerate(zip(scene.views, files, strict=True))
        },
    )


def mark_of(path: Path) -> FileMark:
    """Return the size and digests of a file.

    Raises:
        UserError: The file cannot be read.
    """
    try:
        with path.open("rb") as file:
            digest = sha256(file.read(END))
            size = file.seek(0, 2)
            file.seek(max(END, size - END))
            digest.update(file.read(END))
            file.seek(0)
            # For a small file, the first and the last bytes together already cover the complete
            # file.
            whole = file_digest(file, "sha256").hexdigest() if size > 2 * END else None
    except OSError as error:
        raise UserError(
            "a file of the scene cannot be read",
            where=path,
            found=error.strerror or str(error),
            todo="restore the file, or make it readable",
        ) from error
    return FileMark(bytes=size, sha256=digest.hexdigest(), whole=whole)


def _files_of(view: View) -> tuple[FileMark | None, FileMark | None]:
    photo = view.photo
    # A plugin may provide photos that do not come from files.
    if not isinstance(photo, FilePhoto):
        return None, None
    mask = photo.source.mask
    return mark_of(photo.source.path), None if mask is None else mark_of(mask)


def _numbers_of(camera: Camera) -> tuple[float, ...]:
    pose = camera.world_to_camera
    numbers = [camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy]
    numbers += [*camera.center.tolist(), *pose[0, :3].tolist(), *pose[2, :3].tolist()]
    return tuple(round(float(number), DECIMALS) for number in numbers)


def _points_of(scene: Scene) -> PointsMark:
    if not len(scene.points):
        return PointsMark(count=0, moments=())
    values = np.column_stack([scene.points, scene.point_colors / 255.0])
    moments = (*values.mean(axis=0), *values.std(axis=0))
    return PointsMark(
        count=len(values), moments=tuple(round(float(number), DECIMALS) for number in moments)
    )


class Weight(IntEnum):
    """How much a difference affects a model that was trained on the former scene."""

    #: Only pixels or points differ. All cameras are unchanged, and the trained parameters stay
    #: valid.
    CONTENT = 1
    #: The set of held-out views has changed.
    HELD_OUT = 2
    #: The set of training views has changed, or cameras have moved. The trained parameters would be
    #: at wrong positions in the new scene.
    PLACE = 3


@dataclass(frozen=True)
class Difference:
    """A difference between two fingerprints.

    Attributes:
        weight: How much the difference affects a trained model.
        text: Description of the difference for the user.
    """

    weight: Weight
    text: str


def differences(was: Fingerprint, now: Fingerprint) -> list[Difference]:
    """Return the differences between the former and the current scene.

    The list is empty if both scenes are equal.

    If the training views change, the local frame and all values in local units change as well. If
    the training views have changed, only this change is reported.
    """
    changes = _views(was, now)
    if not any(change.weight is Weight.PLACE for change in changes):
        changes += _frame(was, now) or [*_cameras(was, now), *_points(was, now)]
    changes += _files(was, now)
    # Report changes of other files only if no other difference was found.
    return changes or _others(was, now)


def _views(was: Fingerprint, now: Fingerprint) -> list[Difference]:
    trained, tested = _split(was)
    trains, tests = _split(now)
    changes = [
        *_named(Weight.PLACE, "training photos missing", trained - trains - tests),
        *_named(Weight.PLACE, "new training photos", trains - trained - tested),
        *_named(
            Weight.PLACE, "photos that were training photos and are now held out", trained & tests
        ),
        *_named(
            Weight.PLACE, "photos that were held out and are now training photos", tested & trains
        ),
        *_named(Weight.HELD_OUT, "held-out photos missing", tested - trains - tests),
        *_named(Weight.HELD_OUT, "new held-out photos", tests - trained - tested),
    ]
    if changes and was.lists != now.lists:
        names = {name for name, _ in was.lists.items() ^ now.lists.items()}
        weight = max(change.weight for change in changes)
        changes.append(Difference(weight, f"{' and '.join(sorted(names))} changed"))
    return changes


def _split(of: Fingerprint) -> tuple[set[str], set[str]]:
    trained = {name for name, view in of.views.items() if view.trained}
    return trained, set(of.views) - trained


def _frame(was: Fingerprint, now: Fingerprint) -> list[Difference]:
    before, after = was.frame, now.frame
    shift = max(abs(a - b) for a, b in zip(before.offset, after.offset, strict=True))
    if shift * before.scale < _TOLERANCE and abs(after.scale / before.scale - 1) < _TOLERANCE:
        return []
    text = (
        f"another local frame: its unit is {1 / after.scale:.6g} input units (before: "
        f"{1 / before.scale:.6g}), and its origin moved by {shift:.6g}"
    )
    return [Difference(Weight.PLACE, text)]


def _cameras(was: Fingerprint, now: Fingerprint) -> list[Difference]:
    moved = [
        name
        for name in was.views.keys() & now.views.keys()
        if not _close(was.views[name].camera, now.views[name].camera)
    ]
    return _named(Weight.PLACE, "photos with another size, camera or pose", moved)


def _points(was: Fingerprint, now: Fingerprint) -> list[Difference]:
    before, after = was.points, now.points
    if before.count == after.count and _close(before.moments, after.moments):
        return []
    text = f"other SfM points ({after.count:,}; before {before.count:,})"
    return [Difference(Weight.CONTENT, text)]


def _files(was: Fingerprint, now: Fingerprint) -> list[Difference]:
    common = was.views.keys() & now.views.keys()
    photos = [name for name in common if _differ(was.views[name].photo, now.views[name].photo)]
    masks = [name for name in common if _differ(was.views[name].mask, now.views[name].mask)]
    return [
        *_named(Weight.CONTENT, "photos changed", photos),
        *_named(Weight.CONTENT, "masks that were changed, added or removed", masks),
    ]


def _others(was: Fingerprint, now: Fingerprint) -> list[Difference]:
    """Return differences of files other than photos and masks.

    The list is empty if a fingerprint contains no files.
    """
    if was.files is None or now.files is None:
        return []
    names = was.files.keys() | now.files.keys()
    changed = [name for name in names if _differ(was.files.get(name), now.files.get(name))]
    return _named(Weight.CONTENT, "files that were changed, added or removed", changed)


def _differ(before: FileMark | None, after: FileMark | None) -> bool:
    return before is not after if before is None else before.differs(after)


def _named(weight: Weight, what: str, names: Iterable[str]) -> list[Difference]:
    listed = sorted(names)
    if not listed:
        return []
    return [Difference(weight, f"{what}: {len(listed)} ({name_some(listed)})")]


def _close(before: Sequence[float], after: Sequence[float]) -> bool:
    return len(before) == len(after) and all(
        abs(a - b) <= _TOLERANCE * max(1.0, abs(a)) for a, b in zip(before, after, strict=True)
    )

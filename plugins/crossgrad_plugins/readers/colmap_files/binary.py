"""The contents of a COLMAP model, and a reader of its binary files, record by record.

pycolmap 4.2.1 is not used for reading. For truncated files, it returns wrong cameras without an
error, or never returns and fills the memory.

Source of the format: https://colmap.github.io/format.html (`cameras.bin`, `images.bin`,
`points3D.bin`; little-endian).
"""

import mmap
import os
import struct
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import UserError, open_file
from crossgrad_core.scene.calibration import Calibration
from crossgrad_core.scene.pycolmap_guard import guard_pycolmap

_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")  # id, model, width, height
_IMAGE = struct.Struct("<I7dI")  # id, quaternion wxyz, translation, camera id
_OBSERVATION = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<u8")])
_POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8")])
_TRACK_ELEMENT = 8  # bytes of a track element: image id and index of the observation
_NO_POINT = np.uint64(2**64 - 1)


@dataclass(frozen=True, eq=False)
class ColmapImage:
    """A registered image of a model.

    Attributes:
        name: Name of the image in the model.
        camera: Id of the image's camera.
        quaternion: [4] rotation wxyz, world to camera; its length may differ from 1.
        translation: [3] translation, world to camera.
        points: [S] uint64 ids of the points that the image observed.
    """

    name: str
    camera: int
    quaternion: NDArray[np.float64]
    translation: NDArray[np.float64]
    points: NDArray[np.uint64]


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """A model as stored in its files.

    Attributes:
        cameras: Camera id -> calibration.
        images: The registered images.
        point_ids: [P] uint64 ids of the points.
        points: [P, 3] float64 positions.
        colors: [P, 3] uint8 RGB colours.
    """

    cameras: dict[int, Calibration]
    images: tuple[ColmapImage, ...]
    point_ids: NDArray[np.uint64]
    points: NDArray[np.float64]
    colors: NDArray[np.uint8]


@cache
def camera_models() -> dict[int, tuple[str, int]]:
    """Return COLMAP's camera models: number -> name and number of parameters."""
    guard_pycolmap()
    import pycolmap

    models = pycolmap.CameraModelId.__members__.items()
    return {
        int(number.value): (
            name,
            len(pycolmap.Camera.create_from_model_name(0, name, 1.0, 1, 1).params),
        )
        for name, number in models
        if name != "INVALID"
    }


def by_id(cameras: Iterable[tuple[int, Calibration]], path: Path) -> dict[int, Calibration]:
    """Return the cameras by id.

    Raises:
        UserError: Two cameras have one id.
    """
    calibrations: dict[int, Calibration] = {}
    for camera, calibration in cameras:
        if camera in calibrations:
            raise _twice("cameras", camera, path)
        calibrations[camera] = calibration
    return calibrations


def check_point_ids(ids: NDArray[np.uint64], path: Path) -> None:
    """Refuse a model in which two points have one id.

    Raises:
        UserError: Two points have one id.
    """
    ordered = np.sort(ids)
    twice = np.flatnonzero(ordered[1:] == ordered[:-1])
    if len(twice):
        raise _twice("points", int(ordered[twice[0]]), path)


def _twice(what: str, number: int, path: Path) -> UserError:
    return UserError(
        f"two {what} of the COLMAP model have the same id",
        where=path,
        found=f"id {number}",
        todo="export the model again",
    )


def read_binary(folder: Path) -> ColmapModel:
    """Read `cameras.bin`, `images.bin` and, if it exists, `points3D.bin`.

    Raises:
        UserError: A file is truncated or too long, or its content does not fit its name.
    """
    with _open(folder / "cameras.bin") as file:
        cameras = by_id(_read_cameras(file), file.path)
    with _open(folder / "images.bin") as file:
        images = tuple(_read_images(file))
    points = np.zeros(0, dtype=_POINT)
    if (folder / "points3D.bin").is_file():
        with _open(folder / "points3D.bin") as file:
            points = _read_points(file)
            check_point_ids(points["id"], file.path)
    xyz, colors = np.ascontiguousarray(points["xyz"]), np.ascontiguousarray(points["rgb"])
    return ColmapModel(cameras, images, points["id"], xyz, colors)


class _Walk:
    """A position in a binary file that is being read.

    The position cannot move past the end of the file.
    """

    def __init__(self, path: Path, data: mmap.mmap | bytes) -> None:
        self.path = path
        self.data = data
        self.at = 0

    def skip(self, size: int) -> int:
        """Move on by `size` bytes, and return the position before the move."""
        start, self.at = self.at, self.at + size
        if self.at > len(self.data):
            raise UserError(
                "the file is incomplete: its end is missing",
                where=self.path,
                expected=f"at least {self.at} bytes",
                found=f"{len(self.data)} bytes",
                todo="copy it again, or export the model again",
            )
        return start

    def unpack(self, layout: struct.Struct) -> tuple[int | float, ...]:
        """Return the next values in the given format."""
        return layout.unpack_from(self.data, self.skip(layout.size))

    def count(self, least: int) -> int:
        """Return the next number, a number of records of at least `least` bytes each."""
        number = int(self.unpack(_COUNT)[0])
        here = self.at
        self.skip(number * least)
        self.at = here
        return number

    def text(self) -> str:
        """Return the next text, which ends with a zero byte."""
        end = self.data.find(b"\0", self.at)
        if end < 0:
            end = len(self.data)
        start = self.skip(end + 1 - self.at)
        return os.fsdecode(self.data[start:end])

    def end(self) -> None:
        """Raise an error if the end of the file is not reached."""
        if self.at != len(self.data):
            raise UserError(
                "the file continues after its last record",
                where=self.path,
                expected=f"{self.at} bytes",
                found=f"{len(self.data)} bytes",
                todo="export the model again",
            )


@contextmanager
def _open(path: Path) -> Iterator[_Walk]:
    try:
        file = open_file(path)
    except OSError as error:
        raise UserError(
            "the file cannot be read", where=path, found=str(error), todo="check its permissions"
        ) from error
    with file:
        # An empty file cannot be mapped into memory. The memory map is closed when the last array
        # that uses it is freed.
        empty = path.stat().st_size == 0
        yield _Walk(path, b"" if empty else mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))


def _read_cameras(file: _Walk) -> Iterator[tuple[int, Calibration]]:
    models = camera_models()
    for _ in range(file.count(_CAMERA.size)):
        camera, number, width, height = (int(value) for value in file.unpack(_CAMERA))
        if number not in models:
            raise UserError(
                f"the camera model number {number} is unknown",
                where=file.path,
                expected=", ".join(f"{i} {name}" for i, (name, _) in sorted(models.items())),
                todo="the file is damaged, or a newer COLMAP wrote it: try a newer pycolmap",
            )
        name, count = models[number]
        params = file.unpack(struct.Struct(f"<{count}d"))
        yield camera, Calibration(name, width, height, params)
    file.end()


def _read_images(file: _Walk) -> Iterator[ColmapImage]:
    for _ in range(file.count(_IMAGE.size + 1 + _COUNT.size)):
        _, *pose, camera = file.unpack(_IMAGE)
        name = file.text()
        observations = file.count(_OBSERVATION.itemsize)
        start = file.skip(observations * _OBSERVATION.itemsize)
        ids = np.frombuffer(file.data, _OBSERVATION, observations, start)["point"]
        points = ids[ids != _NO_POINT]
        yield ColmapImage(name, int(camera), np.array(pose[:4]), np.array(pose[4:]), points)
    file.end()


def _read_points(file: _Walk) -> NDArray[np.void]:
    """Return the records [P] of type `_POINT`. Tracks have different lengths and are skipped."""
    number = file.count(_POINT.itemsize + _COUNT.size)
    data, at, starts = file.data, file.at, []
    # Do not call Python functions of this package in this loop, because there may be millions of
    # records.
    track_length, fixed = _COUNT.unpack_from, _POINT.itemsize + _COUNT.size
    try:
        for _ in range(number):
            starts.append(at)
            at += fixed + _TRACK_ELEMENT * track_length(data, at + _POINT.itemsize)[0]
    except (struct.error, OverflowError):
        # The track is longer than the file, or the offset is too large.
        at += fixed
    file.skip(at - file.at)
    file.end()
    if not starts:
        return np.zeros(0, dtype=_POINT)
    windows = np.lib.stride_tricks.sliding_window_view(
        np.frombuffer(data, np.uint8), _POINT.itemsize
    )
    return windows[starts].view(_POINT)[:, 0]

"""COLMAP models in binary files, walked record by record.

Given files that are cut short, pycolmap 4.2.1 reads arbitrary cameras without a word, or loops
without an end and fills the memory.

Source of the format: https://colmap.github.io/format.html (`cameras.bin`, `images.bin`,
`points3D.bin`; little-endian).
"""

import mmap
import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import UserError, open_file
from crossgrad_core.scene.calibration import Calibration
from crossgrad_plugins.readers._colmap_types import (
    ColmapImage,
    ColmapModel,
    by_id,
    camera_models,
    check_point_ids,
)

_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")  # id, model, width, height
_IMAGE = struct.Struct("<I7dI")  # id, quaternion wxyz, translation, camera id
_OBSERVATION = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<u8")])
_POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8")])
_TRACK_ELEMENT = 8  # bytes: image id, index of the observation
_NO_POINT = np.uint64(2**64 - 1)


def read_binary(folder: Path) -> ColmapModel:
    """Reads `cameras.bin`, `images.bin` and, where it is there, `points3D.bin`.

    Raises:
        UserError: A file is cut short, goes on behind its end or is not what its name says.
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
    """A position in a binary file; refuses to pass its end."""

    def __init__(self, path: Path, data: mmap.mmap | bytes) -> None:
        self.path = path
        self.data = data
        self.at = 0

    def skip(self, size: int) -> int:
        """Passes `size` bytes; returns where they start."""
        start, self.at = self.at, self.at + size
        if self.at > len(self.data):
            raise UserError(
                "the file is cut short",
                where=self.path,
                expected=f"at least {self.at} bytes",
                found=f"{len(self.data)} bytes",
                todo="copy it again, or export the model again",
            )
        return start

    def unpack(self, layout: struct.Struct) -> tuple[int | float, ...]:
        """The next values."""
        return layout.unpack_from(self.data, self.skip(layout.size))

    def count(self, least: int) -> int:
        """The next number of records, of `least` bytes each at least."""
        number = int(self.unpack(_COUNT)[0])
        here = self.at
        self.skip(number * least)
        self.at = here
        return number

    def text(self) -> str:
        """The next zero-terminated string."""
        end = self.data.find(b"\0", self.at)
        if end < 0:
            end = len(self.data)
        start = self.skip(end + 1 - self.at)
        return os.fsdecode(self.data[start:end])

    def end(self) -> None:
        """Makes sure that everything was read."""
        if self.at != len(self.data):
            raise UserError(
                "the file goes on behind its last record",
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
        # An empty file cannot be mapped. The map closes with the last array that looks into it.
        empty = path.stat().st_size == 0
        yield _Walk(path, b"" if empty else mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))


def _read_cameras(file: _Walk) -> Iterator[tuple[int, Calibration]]:
    models = camera_models()
    for _ in range(file.count(_CAMERA.size)):
        camera, number, width, height = (int(value) for value in file.unpack(_CAMERA))
        if number not in models:
            raise UserError(
                f"unknown camera model number {number}",
                where=file.path,
                expected=", ".join(f"{i} {name}" for i, (name, _) in sorted(models.items())),
                todo="the file is damaged or of a newer COLMAP: try a newer pycolmap",
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
    """[P] records `_POINT`; tracks, of any length, are passed over."""
    number = file.count(_POINT.itemsize + _COUNT.size)
    data, at, starts = file.data, file.at, []
    # Millions of records: no call of our own for each.
    track_length, fixed = _COUNT.unpack_from, _POINT.itemsize + _COUNT.size
    try:
        for _ in range(number):
            starts.append(at)
            at += fixed + _TRACK_ELEMENT * track_length(data, at + _POINT.itemsize)[0]
    except (struct.error, OverflowError):  # behind the end, or further than can be counted
        at += fixed
    file.skip(at - file.at)
    file.end()
    if not starts:
        return np.zeros(0, dtype=_POINT)
    windows = np.lib.stride_tricks.sliding_window_view(
        np.frombuffer(data, np.uint8), _POINT.itemsize
    )
    return windows[starts].view(_POINT)[:, 0]

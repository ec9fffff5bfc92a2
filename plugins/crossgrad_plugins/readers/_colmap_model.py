"""COLMAP models: cameras, images and points, from binary or text files.

Binary files are walked here, record by record, rather than by pycolmap: given files that are cut
short, pycolmap 4.2.1 reads arbitrary cameras without a word, or loops without an end and fills the
memory. Text files do go through pycolmap, which refuses bad ones.

Source of the format: https://colmap.github.io/format.html (`cameras.bin`, `images.bin`,
`points3D.bin`; little-endian).
"""

import mmap
import os
import struct
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.errors import UserError
from crossgrad_core.scene.calibration import Calibration
from crossgrad_core.scene.pycolmap_guard import guard_pycolmap

_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")  # id, model, width, height
_IMAGE = struct.Struct("<I7dI")  # id, quaternion wxyz, translation, camera id
_OBSERVATION = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<u8")])
_POINT = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8")])
_TRACK_ELEMENT = 8  # bytes: image id, index of the observation
_NO_POINT = np.uint64(2**64 - 1)


@dataclass(frozen=True, eq=False)
class ColmapImage:
    """A registered image.

    Attributes:
        name: As written in the model.
        camera: Id of its camera.
        quaternion: [4] wxyz, world to camera, not necessarily normalised.
        translation: [3].
        points: [S] uint64 ids of the points that it observes.
    """

    name: str
    camera: int
    quaternion: NDArray[np.float64]
    translation: NDArray[np.float64]
    points: NDArray[np.uint64]


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """A model as it is in its files.

    Attributes:
        cameras: Camera id -> calibration.
        images: The registered images.
        point_ids: [P] uint64.
        points: [P, 3] float64.
        colors: [P, 3] uint8 RGB.
    """

    cameras: dict[int, Calibration]
    images: tuple[ColmapImage, ...]
    point_ids: NDArray[np.uint64]
    points: NDArray[np.float64]
    colors: NDArray[np.uint8]


def has_model(folder: Path) -> bool:
    """Whether a folder holds the cameras and images of a COLMAP model."""
    return _has(folder, "bin") or _has(folder, "txt")


def count_images(folder: Path) -> int:
    """Number of registered images of a model, from the head of its files; 0 if unreadable."""
    try:
        if _has(folder, "bin"):
            with (folder / "images.bin").open("rb") as file:
                return int(_COUNT.unpack(file.read(_COUNT.size))[0])
        with (folder / "images.txt").open(encoding="utf-8", errors="replace") as lines:
            # Two lines for each image, of which the second may be empty.
            return sum(not line.startswith("#") for line in lines) // 2
    except (OSError, struct.error):
        return 0


def read_model(folder: Path) -> ColmapModel:
    """Reads a model; where it is there in both forms, the binary one, as COLMAP does.

    Raises:
        UserError: A file is missing, cut short or not what its name says.
    """
    if _has(folder, "bin"):
        return _read_binary(folder)
    with tempfile.TemporaryDirectory(prefix="crossgrad-colmap-") as converted:
        _convert_text(folder, Path(converted))
        return _read_binary(Path(converted))


def _has(folder: Path, suffix: str) -> bool:
    return all((folder / f"{name}.{suffix}").is_file() for name in ("cameras", "images"))


def _convert_text(folder: Path, converted: Path) -> None:
    """Writes the binary form of a text model into another folder."""
    guard_pycolmap()
    import pycolmap

    try:
        model = pycolmap.Reconstruction()
        model.read_text(folder)
        model.write_binary(converted)
    except (ValueError, IndexError, RuntimeError, OSError) as error:
        raise UserError(
            "the COLMAP text model cannot be read",
            where=folder,
            found=str(error),
            todo="repair the file, or export the model again",
        ) from error


def _read_binary(folder: Path) -> ColmapModel:
    with _open(folder / "cameras.bin") as file:
        cameras = dict(_read_cameras(file))
    with _open(folder / "images.bin") as file:
        images = tuple(_read_images(file))
    points = np.zeros(0, dtype=_POINT)
    if (folder / "points3D.bin").is_file():
        with _open(folder / "points3D.bin") as file:
            points = _read_points(file)
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
        file = path.open("rb")
    except OSError as error:
        raise UserError(
            "the file cannot be read",
            where=path,
            found=str(error),
            todo="check that it is there and may be read, or export the model again",
        ) from error
    with file:
        # An empty file cannot be mapped. The map closes with the last array that looks into it.
        empty = path.stat().st_size == 0
        yield _Walk(path, b"" if empty else mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))


def _read_cameras(file: _Walk) -> Iterator[tuple[int, Calibration]]:
    guard_pycolmap()
    import pycolmap

    models = {int(model.value): name for name, model in pycolmap.CameraModelId.__members__.items()}
    for _ in range(file.count(_CAMERA.size)):
        camera, number, width, height = (int(value) for value in file.unpack(_CAMERA))
        name = models.get(number, "INVALID")
        if name == "INVALID":
            raise UserError(
                f"unknown camera model number {number}",
                where=file.path,
                expected=", ".join(f"{i} {n}" for i, n in sorted(models.items()) if i >= 0),
                todo="the file is damaged or of a newer COLMAP: try a newer pycolmap",
            )
        blank = pycolmap.Camera.create_from_model_name(0, name, 1.0, 1, 1)
        params = file.unpack(struct.Struct(f"<{len(blank.params)}d"))
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
    except struct.error:
        at += fixed
    file.skip(at - file.at)
    file.end()
    if not starts:
        return np.zeros(0, dtype=_POINT)
    windows = np.lib.stride_tricks.sliding_window_view(
        np.frombuffer(data, np.uint8), _POINT.itemsize
    )
    return windows[starts].view(_POINT)[:, 0]

"""Readers of COLMAP models: cameras, images and points, from binary or text files."""

import os
import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import UserError, open_file
from crossgrad_core.scene.calibration import Calibration
from crossgrad_plugins.readers.colmap_files.binary import (
    ColmapImage,
    ColmapModel,
    by_id,
    camera_models,
    check_point_ids,
    read_binary,
)

_CAMERA = "CAMERA_ID MODEL WIDTH HEIGHT PARAMS ..."
_IMAGE = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
_OBSERVATIONS = "X Y POINT3D_ID ..."
_POINT = "POINT3D_ID X Y Z R G B ERROR TRACK ..."
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
_NO_POINT = b"-1"
_INTEGER = re.compile(rb"[0-9]{1,20}")
_MOST = 2**64 - 1


def read_text(folder: Path) -> ColmapModel:
    """Read `cameras.txt`, `images.txt` and, if it exists, `points3D.txt`.

    Images and points are sorted by their ids.

    Raises:
        UserError: A line is wrong; the message names the line.
    """
    cameras = _Lines(folder / "cameras.txt")
    calibrations = by_id(_read_cameras(cameras), cameras.path)
    images = dict(_read_images(_Lines(folder / "images.txt")))
    path = folder / "points3D.txt"
    rows = list(_read_points(_Lines(path))) if path.is_file() else []
    ids = np.array([row[0] for row in rows], dtype=np.uint64)
    check_point_ids(ids, path)
    order = np.argsort(ids)
    xyz = np.array([row[1] for row in rows], dtype=np.float64).reshape(-1, 3)
    colors = np.array([row[2] for row in rows], dtype=np.uint8).reshape(-1, 3)
    ordered = tuple(images[number] for number in sorted(images))
    return ColmapModel(calibrations, ordered, ids[order], xyz[order], colors[order])


class _Lines:
    """The data lines of a text file. Errors name the current line.

    Args:
        path: The text file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._number = 0
        try:
            with open_file(path) as file:
                content = file.read()
        except OSError as error:
            raise UserError(
                "the file cannot be read",
                where=path,
                found=str(error),
                todo="check its permissions",
            ) from error
        self._lines = iter(content.removeprefix(_BYTE_ORDER_MARK).splitlines())

    def __iter__(self) -> Iterator[bytes]:
        """Iterate over the lines that are neither empty nor comments."""
        while (line := self.next()) is not None:
            if line and not line.startswith(b"#"):
                yield line

    def next(self) -> bytes | None:
        """Return the next line, which may be empty or a comment; None at the end."""
        self._number += 1
        line = next(self._lines, None)
        return None if line is None else line.strip()

    def wrong(self, line: bytes, expected: str) -> NoReturn:
        """Raise an error about the line that was read last."""
        raise UserError(
            "a line of the COLMAP text model cannot be read",
            where=f"{self.path}, line {self._number}",
            expected=expected,
            found=line.decode("utf-8", errors="replace"),
            todo="correct the line, or export the model again",
        )


def _integer(word: bytes, most: int = _MOST) -> int:
    """Return a whole number that has no sign.

    Raises:
        ValueError: The word is not a whole number without sign, or the number is too large.
    """
    if not _INTEGER.fullmatch(word) or int(word) > most:
        raise ValueError(word)
    return int(word)


def _number(word: bytes) -> float:
    """Return a number that is written as in C.

    Raises:
        ValueError: The word is not a number.
    """
    if b"_" in word:  # Python would accept underscores between digits.
        raise ValueError(word)
    return float(word)


def _read_cameras(lines: _Lines) -> Iterator[tuple[int, Calibration]]:
    counts = dict(camera_models().values())
    for line in lines:
        words = line.split()
        try:
            camera, width, height = (_integer(words[i]) for i in (0, 2, 3))
            params = tuple(map(_number, words[4:]))
        except (ValueError, IndexError):
            lines.wrong(line, _CAMERA)
        model = words[1].decode("utf-8", errors="replace")
        if model not in counts:
            lines.wrong(line, f"a camera model of COLMAP: {', '.join(sorted(counts))}")
        if len(params) != counts[model]:
            lines.wrong(line, f"{_CAMERA} with {counts[model]} parameters for {model}")
        yield camera, Calibration(model, width, height, params)


def _read_images(lines: _Lines) -> Iterator[tuple[int, ColmapImage]]:
    seen: set[int] = set()
    for line in lines:
        words = line.split(maxsplit=9)
        try:
            number, camera = _integer(words[0]), _integer(words[8])
            pose = np.array([_number(word) for word in words[1:8]])
            name = os.fsdecode(words[9])
        except (ValueError, IndexError):
            lines.wrong(line, _IMAGE)
        if number in seen:
            lines.wrong(line, f"an IMAGE_ID that occurs only once, unlike {number}")
        seen.add(number)
        points = _read_observations(lines)
        yield number, ColmapImage(name, camera, pose[:4], pose[4:], points)


def _read_observations(lines: _Lines) -> NDArray[np.uint64]:
    """Return the point ids in the line that follows an image. The line may be empty."""
    line = lines.next() or b""
    try:
        return np.array(_observed(line), dtype=np.uint64)
    except ValueError:
        lines.wrong(line, _OBSERVATIONS)


def _observed(line: bytes) -> list[int]:
    words = line.split()
    if len(words) % 3 or b"_" in line:
        raise ValueError(line)
    np.array(words, dtype=np.float64)  # Pixel positions are not used, but they must be numbers.
    return [_integer(word) for word in words[2::3] if word != _NO_POINT]


def _read_points(lines: _Lines) -> Iterator[tuple[int, list[float], list[int]]]:
    """Yield id, position and colour of every point; tracks are skipped."""
    for line in lines:
        words = line.split(maxsplit=8)
        try:
            number = _integer(words[0])
            position = [_number(word) for word in words[1:4]]
            color = [_integer(word, 255) for word in words[4:7]]
            _number(words[7])
        except (ValueError, IndexError):
            lines.wrong(line, _POINT)
        yield number, position, color


_COUNT = struct.Struct("<Q")


def has_model(folder: Path) -> bool:
    """Return True if a folder contains the cameras and images of a COLMAP model."""
    return _has(folder, "bin") or _has(folder, "txt")


def count_images(folder: Path) -> int:
    """Return the number of registered images of a model, or 0 if its files are unreadable."""
    try:
        if _has(folder, "bin"):
            with (folder / "images.bin").open("rb") as file:
                return int(_COUNT.unpack(file.read(_COUNT.size))[0])
        with (folder / "images.txt").open(encoding="utf-8", errors="replace") as lines:
            # Each image has two lines; the second line may be empty.
            return sum(not line.startswith("#") for line in lines) // 2
    except (OSError, struct.error):
        return 0


def read_model(folder: Path) -> ColmapModel:
    """Read a model. If there are binary and text files, the binary files are read, as COLMAP does.

    Raises:
        UserError: A file is missing or truncated, or its content does not fit its name.
    """
    return read_binary(folder) if _has(folder, "bin") else read_text(folder)


def model_files(folder: Path) -> tuple[Path, ...]:
    """Return the files that `read_model` reads."""
    suffix = "bin" if _has(folder, "bin") else "txt"
    paths = (folder / f"{name}.{suffix}" for name in ("cameras", "images", "points3D"))
    return tuple(path for path in paths if path.is_file())


def _has(folder: Path, suffix: str) -> bool:
    return all((folder / f"{name}.{suffix}").is_file() for name in ("cameras", "images"))

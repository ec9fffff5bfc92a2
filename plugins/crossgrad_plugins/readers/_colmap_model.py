"""COLMAP models: cameras, images and points, from binary or text files."""

import struct
from pathlib import Path

from crossgrad_plugins.readers._colmap_binary import read_binary
from crossgrad_plugins.readers._colmap_text import read_text
from crossgrad_plugins.readers._colmap_types import ColmapModel

_COUNT = struct.Struct("<Q")


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
    return read_binary(folder) if _has(folder, "bin") else read_text(folder)


def model_files(folder: Path) -> tuple[Path, ...]:
    """Return the files that `read_model` reads."""
    suffix = "bin" if _has(folder, "bin") else "txt"
    paths = (folder / f"{name}.{suffix}" for name in ("cameras", "images", "points3D"))
    return tuple(path for path in paths if path.is_file())


def _has(folder: Path, suffix: str) -> bool:
    return all((folder / f"{name}.{suffix}").is_file() for name in ("cameras", "images"))

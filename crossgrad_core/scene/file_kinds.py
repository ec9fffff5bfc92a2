"""Kinds of files in a scene's folder, by their names."""

import re
from pathlib import PurePosixPath
from typing import Final

from crossgrad_core.scene.heif import SUFFIXES

#: Suffixes of photos and masks.
IMAGES: Final = frozenset(
    {".avif", ".bmp", ".gif", ".jp2", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tif", ".tiff"}
    | {".webp", *SUFFIXES}
)
#: Kinds of files.
PHOTO, COPY, MASK, DEPTH = "photo", "smaller copy of a photo", "mask", "depth or normal map"
RAW, POINTS, TABLE = "raw photo", "point file", "CSV file"

_BY_SUFFIX: Final = {
    **dict.fromkeys((".exr", ".pfm"), DEPTH),
    **dict.fromkeys((".3fr", ".arw", ".cr2", ".cr3", ".dng", ".nef", ".orf", ".raf", ".rw2"), RAW),
    **dict.fromkeys((".e57", ".las", ".laz", ".pcd", ".ply", ".pts", ".ptx", ".xyz"), POINTS),
    ".csv": TABLE,
}
_WORDS: Final = {
    **dict.fromkeys(("alpha", "mask", "masks", "matte", "mattes", "seg", "segmentation"), MASK),
    **dict.fromkeys(("silhouette", "silhouettes"), MASK),
    **dict.fromkeys(("depth", "depths", "disparity", "normal", "normals"), DEPTH),
}
_COPIES: Final = re.compile(r"(images|photos|rgb)_[248]")
#: Files of numbers, of any kind unless a word says which.
_ARRAYS: Final = frozenset({".npy", ".npz"})


def kind_of(name: str) -> str | None:
    """Return the kind of a file by its path below the scene; None for files of no known kind.

    Images are photos, unless a word in their name or in the names of their folders says otherwise.
    """
    path = PurePosixPath(name)
    suffix = path.suffix.lower()
    if suffix not in IMAGES | _ARRAYS:
        return _BY_SUFFIX.get(suffix)
    words = (word for part in path.parts for word in re.split("[^a-z]+", part.lower()))
    said = next((_WORDS[word] for word in words if word in _WORDS), None)
    if said or suffix in _ARRAYS:
        return said
    return COPY if any(map(_COPIES.fullmatch, path.parts[:-1])) else PHOTO

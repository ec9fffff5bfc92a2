"""Match the files of a scene with names from other programs, and derive file kinds from names.

Names from other programs may differ in folders, suffix or letter case.
"""

import os
import re
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import takewhile
from pathlib import PurePosixPath, PureWindowsPath
from typing import Final, TypeAlias

from crossgrad_core.scene.photos.pillow import SUFFIXES

#: Similarity of a file's path to a name; greater is more similar. The elements are: equal folders,
#: number of equal folders at the end, whether one path ends with the other path, equal base name
#: except letter case, equal base name.
_Likeness: TypeAlias = tuple[bool, int, bool, bool, bool]
#: Suffixes of photos and masks.
IMAGES: Final = frozenset(
    {".avif", ".bmp", ".gif", ".jp2", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tif", ".tiff"}
    | {".webp", *SUFFIXES}
)
#: Kinds of files, as named in messages.
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
#: Suffixes of array files. The kind of an array file is known only if a word in its path names a
#: kind.
_ARRAYS: Final = frozenset({".npy", ".npz"})


@dataclass(frozen=True)
class Pairs:
    """Names, and the files that match these names.

    Attributes:
        files: Name -> the only file that matches the name.
        ambiguous: Name -> the files that match the name equally well.
    """

    files: Mapping[str, str]
    ambiguous: Mapping[str, Sequence[str]]


class FileNames:
    """Files below a folder. The files can be found by the names that other programs use for them.

    A name matches the file with exactly the same path. Without such a file, the name matches the
    file with the same base name and the most similar path. Suffix, letter case and Unicode form may
    differ. A file in another folder matches only if the folder in the name does not exist. If this
    folder exists but does not contain the file, the name has no file.

    Args:
        names: Paths of the files below the folder, with forward slashes.
        called: Function from a path to the path that is compared with names.
        aside: Function that returns True for a path that must not match names in other folders.
    """

    def __init__(
        self,
        names: Iterable[str],
        called: Callable[[str], str] = str,
        aside: Callable[[str], bool] = lambda _: False,
    ) -> None:
        self._aside = aside
        self._called = {name: called(name) for name in sorted(names)}
        self._folders = {folder for name in self._called for folder in _folders(name)}
        self._alike = defaultdict[str, list[str]](list)
        for name, call in self._called.items():
            self._alike[_base(without_suffix(call))].append(name)

    def find(self, name: str) -> str | None:
        """Return the only file that matches a name.

        Return None if no file or several files match.
        """
        return self.pair((name,)).files.get(name)

    def fitting(self, name: str) -> list[str]:
        """Return the files that match a name equally well, in sorted order."""
        pairs = self.pair((name,))
        return sorted(pairs.ambiguous.get(name) or filter(None, [pairs.files.get(name)]))

    def pair(self, names: Collection[str], taken: Container[str] = ()) -> Pairs:
        """Find the file of each name.

        If several names match a file, the file belongs to the name that is most similar to its
        path.

        Args:
            names: Relative or absolute paths, with forward slashes or backslashes.
            taken: Files that must not be matched with any name.
        """
        exact = {name: name for name in names if name in self._called and name not in taken}
        best = {
            name: self._most_alike(name, lambda file: file in taken or file in exact)
            for name in names
            if name not in exact
        }
        claims = defaultdict[str, list[_Likeness]](list)
        for likeness, files in best.values():
            for file in files:
                claims[file].append(likeness)
        # A file is not matched with this name if another name is more similar to the path of the
        # file.
        held = {
            name: (likeness, [file for file in files if likeness == max(claims[file])])
            for name, (likeness, files) in best.items()
        }
        claimed = Counter((likeness, file) for likeness, files in held.values() for file in files)
        clear = {
            name: files[0]
            for name, (likeness, files) in held.items()
            if len(files) == 1 and claimed[likeness, files[0]] == 1
        }
        unclear = {name: files for name, (_, files) in held.items() if files and name not in clear}
        return Pairs({**exact, **clear}, unclear)

    def _most_alike(
        self, name: str, is_taken: Callable[[str], bool]
    ) -> tuple[_Likeness, list[str]]:
        """Return the files whose paths are most similar to a name, and their similarity."""
        likeness_by_file: dict[str, _Likeness] = {}
        for base in {_base(name), _stem(name)}:
            for file in self._alike.get(base, ()):
                likeness = None if is_taken(file) else self._likeness(name, file)
                if likeness is not None:
                    likeness_by_file[file] = likeness
        most = max(likeness_by_file.values(), default=(False, 0, False, False, False))
        return most, [file for file, likeness in likeness_by_file.items() if likeness == most]

    def _likeness(self, name: str, file: str) -> _Likeness | None:
        """Return the similarity of a file's path to a name.

        Return None if the file must not match the name.
        """
        call = self._called[file]
        name_folders, file_folders = _folders(name), _folders(call)
        pairs = zip(reversed(name_folders), reversed(file_folders), strict=False)
        shared = sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))
        ends = shared in {len(name_folders), len(file_folders)}
        missing = shared < len(name_folders) and name_folders[-1 - shared] in self._folders
        if name_folders != file_folders and (missing or self._aside(file)):
            return None
        # A name without a suffix may still contain dots.
        whole = _base(name) in {_base(call), _base(without_suffix(call))}
        return (
            name_folders == file_folders,
            shared,
            ends,
            whole,
            _parts(name)[-1] == _parts(call)[-1],
        )


def is_absolute(name: str) -> bool:
    """Return True if a name is an absolute path on this system or on Windows."""
    return name.startswith(("/", "\\")) or bool(PureWindowsPath(name).drive)


def same_spelling(name: str, other: str) -> bool:
    """Return True if two names are equal except for suffix, letter case and Unicode form."""
    return _folders(name) == _folders(other) and _stem(name) == _stem(other)


def without_suffix(name: str) -> str:
    """Return a name without its image suffix.

    Without an image suffix, the name is returned unchanged.
    """
    stem, suffix = os.path.splitext(name)
    return stem if suffix.lower() in IMAGES else name


def _parts(name: str) -> list[str]:
    return [part for part in name.replace("\\", "/").split("/") if part not in {"", "."}]


def _folders(name: str) -> list[str]:
    return [_fold(folder) for folder in _parts(name)[:-1]]


def _base(name: str) -> str:
    """Return the base name of a path. Letter case and Unicode form are normalized."""
    return _fold("".join(_parts(name)[-1:]))


def _stem(name: str) -> str:
    """Return the base name of a path without its suffix.

    Letter case and Unicode form are normalized.
    """
    return PurePosixPath(_base(name)).stem


def _fold(text: str) -> str:
    return unicodedata.normalize("NFC", text).casefold()


def kind_of(name: str) -> str | None:
    """Return the kind of a file, derived from its path below the scene.

    Return None if the kind is unknown.

    Images are photos, unless a word in the path names another kind.
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

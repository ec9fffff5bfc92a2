"""Names of files within a scene: none leads out of its folder, neither by `..` nor by a link."""

import os
import posixpath
import re
import unicodedata
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Final

from crossgrad_core.plugin import UserError

#: Smaller copies of a photo folder, which are read in its place.
_REDUCED: Final = ("", "_2", "_4", "_8")
#: Bytes of a file or folder, and of a whole name.
_LONGEST_PART, _LONGEST_NAME = 255, 1024
_NO_SIGNS: Final = {"Cc", "Cs"}  # control characters, and bytes that are not UTF-8
#: Folders that tell training views from held-out ones and nothing else.
SPLIT_FOLDERS: Final = frozenset({"train", "test", "val"})


@dataclass(frozen=True)
class Inside:
    """The files of one scene, by names that a file of the scene gives them.

    Attributes:
        scene: The scene's folder.
    """

    scene: Path

    @cached_property
    def _true(self) -> str:
        return os.path.realpath(self.scene)

    def name(self, text: str, where: object, base: str = "") -> str:
        """A name relative to the folder `base` of the scene, as a plain one below the scene.

        Raises:
            UserError: It leads out of the scene, or no file can have it.
        """
        if not _possible(text):
            raise _impossible(where, text)
        slashed = text.replace("\\", "/")
        plain = posixpath.normpath(posixpath.join(base, slashed))
        absolute = slashed.startswith("/") or PureWindowsPath(text).drive
        if absolute or plain in {".", ".."} or plain.startswith("../"):
            raise _outside(where, repr(text))
        return plain

    def file(self, name: str, where: object) -> Path:
        """The file of a plain name, there or not.

        Raises:
            UserError: A link leads out of the scene, or the system takes no such name.
        """
        path = self.scene / name
        self._check(path, where)
        return path

    def photo(self, images: str, text: str, where: object) -> str:
        """A name relative to the photo folder `images`, as a plain one below it.

        Raises:
            UserError: See `name` and `file`.
        """
        plain = self.name(text, where)
        self.file(f"{images}/{plain}", where)
        return plain

    def files(self, pattern: str) -> list[Path]:
        """The files of the scene's own folder that fit a pattern, sorted; none if unreadable."""
        try:
            return sorted(path for path in self.scene.glob(pattern) if path.is_file())
        except OSError:
            return []

    def check_photos(self, images: str) -> None:
        """Refuses links out of the scene among the photos, their smaller copies and the masks.

        Photos may be found by a name that differs in suffix or case, so that all files count.

        Args:
            images: Plain name of the photo folder, `.` for the scene itself.

        Raises:
            UserError: There is such a link.
        """
        folders = [images] if images == "." else [f"{images}{size}" for size in _REDUCED]
        for folder in (*folders, "masks"):
            place = self.scene / folder
            if place.is_dir():
                self._check(place, place)
            for base, inner, files in os.walk(place):
                for name in (*inner, *files):
                    path = Path(base, name)
                    if path.is_symlink():
                        self._check(path, path)

    def _check(self, path: Path, where: object) -> None:
        try:
            true = os.path.realpath(path)
        except (OSError, ValueError) as error:
            raise _outside(where, str(error)) from error
        if true != self._true and not true.startswith(os.path.join(self._true, "")):
            raise _outside(where, f"a link to {true}")


def _outside(where: object, found: str) -> UserError:
    return UserError(
        "a file name leads out of the scene",
        where=where,
        expected="a file below the scene's folder, relative to it",
        found=found,
        todo="copy the file into the scene and mend the name, or name the folder that holds "
        "everything as the scene",
    )


def _possible(text: str) -> bool:
    """Whether a file can have a name, on every usual file system."""
    if any(unicodedata.category(sign) in _NO_SIGNS for sign in text):
        return False
    longest = max(len(os.fsencode(part)) for part in re.split(r"[/\\]", text))
    return longest <= _LONGEST_PART and len(os.fsencode(text)) <= _LONGEST_NAME


def _impossible(where: object, text: str) -> UserError:
    return UserError(
        "a name that no file can have",
        where=where,
        expected=f"UTF-8 without control characters, at most {_LONGEST_PART} bytes for a file or "
        "folder",
        found=ascii(text),
        todo="mend the name in the file, or export it again",
    )


def shared_folder(names: Iterable[str]) -> str:
    """The first folder of all names below a scene, `.` where they have none in common."""
    first = {PurePosixPath(name).parts[:-1][:1] for name in names}
    return first.pop()[0] if len(first) == 1 and first != {()} else "."


def place_of(name: str) -> str:
    """A name without the folders that only tell training views from held-out ones."""
    parts = PurePosixPath(name).parts
    kept = [part for part in parts[:-1] if part.lower() not in SPLIT_FOLDERS]
    return "/".join((*kept, parts[-1]))

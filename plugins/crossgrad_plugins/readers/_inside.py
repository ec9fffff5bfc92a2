"""Names of files in a scene, which must not lead out of the scene's folder.

Symbolic links are followed before this check. docs/reliability.md explains the rule.
"""

import os
import posixpath
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Final

from crossgrad_core.plugin import UserError, is_file
from crossgrad_core.scene.photos.file_names import (
    MASK,
    PHOTO,
    POINTS,
    FileNames,
    is_absolute,
    kind_of,
    same_spelling,
)
from crossgrad_core.scene.photos.photo_files import walked
from crossgrad_core.scene.raw import LONGEST_NAME, LONGEST_PART, is_possible_name

#: Names of folders that only separate training views from held-out views.
SPLIT_FOLDERS: Final = frozenset({"train", "test", "val"})


@dataclass(frozen=True)
class Inside:
    """The files of a scene, found by the names in the scene's own files.

    Attributes:
        scene: The scene's folder.
    """

    scene: Path

    @cached_property
    def _true(self) -> str:
        return os.path.realpath(self.scene)

    @cached_property
    def _files(self) -> list[str]:
        """Paths of all files of the scene."""
        tree = ((PurePosixPath(below), files) for below, _, files in walked(self.scene))
        return [(below / file).as_posix() for below, files in tree for file in files]

    @cached_property
    def photos(self) -> FileNames:
        """The photos of the scene; a photo can be found by the end of its path."""
        return FileNames(name for name in self._files if kind_of(name) == PHOTO)

    @cached_property
    def masks(self) -> FileNames:
        """The masks of the scene; a mask can be found by the end of its path."""
        return FileNames(name for name in self._files if kind_of(name) == MASK)

    @cached_property
    def points(self) -> FileNames:
        """The point files of the scene; a file can be found by the end of its path."""
        return FileNames(name for name in self._files if kind_of(name) == POINTS)

    def name(self, text: str, where: object, base: str = "") -> str:
        """Convert a name relative to the folder `base` into a name relative to the scene.

        Raises:
            UserError: The name leads out of the scene, or is not a possible file name.
        """
        if not is_possible_name(text):
            raise _impossible(where, text)
        plain = self._plain(text, base)
        if plain is None:
            raise _outside(where, repr(text))
        return plain

    def found(self, text: str, where: object, base: str, files: FileNames) -> str:
        """Convert a name as `name` does.

        If there is no such file, search `files` by the end of the path.

        Raises:
            UserError: There is no such file, and the name leads out of the scene.
        """
        plain = self._plain(text, base)
        if plain is None or not is_file(self.scene / plain):
            other = files.find(plain or text)
            # Return the name with the suffix and letter case of the pose file. A later step finds
            # the photo with another suffix or case, and writes a note.
            if other is not None and (plain is None or not same_spelling(plain, other)):
                return other
        return self.name(text, where, base)

    def _plain(self, text: str, base: str) -> str | None:
        """Return a normalised name relative to the scene; None if it leads out of the scene."""
        slashed = text.replace("\\", "/")
        for root in (os.path.abspath(self.scene), self._true):
            if slashed.startswith(os.path.join(root, "")):
                slashed, base = os.path.relpath(slashed, root), ""
        plain = posixpath.normpath(posixpath.join(base, slashed))
        leads_out = is_absolute(slashed) or plain in {".", ".."} or plain.startswith("../")
        return None if leads_out else plain

    def file(self, name: str, where: object) -> Path:
        """Return the path of a file with a normalised name.

        The file may be missing, or may itself be a link. This check is not used for photos and
        masks. Their folder may be anywhere, and files that are not images are refused.

        Raises:
            UserError: A folder in the path is a link that leads out of the scene.
        """
        path = self.scene / name
        true = os.path.realpath(path.parent)
        if true != self._true and not true.startswith(os.path.join(self._true, "")):
            raise _outside(where, f"{path.parent} is a link to {true}")
        return path

    def files(self, pattern: str) -> list[Path]:
        """Return the matching files in the scene's folder, sorted.

        None if the folder is unreadable.
        """
        try:
            return sorted(path for path in self.scene.glob(pattern) if path.is_file())
        except OSError:
            return []


def _outside(where: object, found: str) -> UserError:
    return UserError(
        "a file name points outside the scene folder",
        where=where,
        expected="a path relative to the scene folder and inside it",
        found=found,
        todo="copy the file into the scene folder and correct the name, or use a folder "
        "that contains all files as the scene",
    )


def _impossible(where: object, text: str) -> UserError:
    return UserError(
        "a file name is not valid",
        where=where,
        expected=f"UTF-8 without control characters, at most {LONGEST_PART} bytes for a file or "
        f"folder and {LONGEST_NAME} in all",
        found=ascii(text),
        todo="correct the name in the file, or export the file again",
    )


def shared_folder(names: Iterable[str]) -> str:
    """Return the first folder that is common to all names; `.` if there is none."""
    first = {PurePosixPath(name).parts[:-1][:1] for name in names}
    return first.pop()[0] if len(first) == 1 and first != {()} else "."


def place_of(name: str) -> str:
    """Return a name without folders that only separate training views from held-out views."""
    parts = PurePosixPath(name).parts
    kept = [part for part in parts[:-1] if part.lower() not in SPLIT_FOLDERS]
    return "/".join((*kept, parts[-1]))

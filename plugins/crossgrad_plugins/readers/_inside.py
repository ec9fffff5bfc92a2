"""Names of files within a scene: a name must not lead out of the folder of the scene.

Symbolic links are resolved. docs/reliability.md explains the rule.
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

#: Folders that only separate training views from held-out views.
SPLIT_FOLDERS: Final = frozenset({"train", "test", "val"})


@dataclass(frozen=True)
class Inside:
    """The files of one scene, found by the names that the scene's own files use.

    Attributes:
        scene: The scene's folder.
    """

    scene: Path

    @cached_property
    def _true(self) -> str:
        return os.path.realpath(self.scene)

    @cached_property
    def _files(self) -> list[str]:
        """Paths of all files in the scene."""
        tree = ((PurePosixPath(below), files) for below, _, files in walked(self.scene))
        return [(below / file).as_posix() for below, files in tree for file in files]

    @cached_property
    def photos(self) -> FileNames:
        """The photos of the scene, which can be found by the end of their path."""
        return FileNames(name for name in self._files if kind_of(name) == PHOTO)

    @cached_property
    def masks(self) -> FileNames:
        """The masks of the scene, which can be found by the end of their path."""
        return FileNames(name for name in self._files if kind_of(name) == MASK)

    @cached_property
    def points(self) -> FileNames:
        """The point files of the scene, which can be found by the end of their path."""
        return FileNames(name for name in self._files if kind_of(name) == POINTS)

    def name(self, text: str, where: object, base: str = "") -> str:
        """Return a name relative to the scene, from a name relative to its folder `base`.

        Raises:
            UserError: The name leads out of the scene, or no file can have this name.
        """
        if not is_possible_name(text):
            raise _impossible(where, text)
        plain = self._plain(text, base)
        if plain is None:
            raise _outside(where, repr(text))
        return plain

    def found(self, text: str, where: object, base: str, files: FileNames) -> str:
        """Return the result of `name`.

        If the file is missing, search `files` by the end of the path.

        Raises:
            UserError: There is no such file, and the name leads out of the scene.
        """
        plain = self._plain(text, base)
        if plain is None or not is_file(self.scene / plain):
            other = files.find(plain or text)
            # Return the name with its own suffix and letter case. A later step matches the photo
            # and writes a note.
            if other is not None and (plain is None or not same_spelling(plain, other)):
                return other
        return self.name(text, where, base)

    def _plain(self, text: str, base: str) -> str | None:
        """Return a normalised name relative to the scene, or None if it leads out of the scene."""
        slashed = text.replace("\\", "/")
        for root in (os.path.abspath(self.scene), self._true):
            if slashed.startswith(os.path.join(root, "")):
                slashed, base = os.path.relpath(slashed, root), ""
        plain = posixpath.normpath(posixpath.join(base, slashed))
        leads_out = is_absolute(slashed) or plain in {".", ".."} or plain.startswith("../")
        return None if leads_out else plain

    def file(self, name: str, where: object) -> Path:
        """Return the path of a normalised name. The file may be missing, or may be a link.

        Photos and masks do not need this check: the folder of the photos may be anywhere, and a
        file that is not a photo is refused.

        Raises:
            UserError: A folder in the path is a link that leads out of the scene.
        """
        path = self.scene / name
        true = os.path.realpath(path.parent)
        if true != self._true and not true.startswith(os.path.join(self._true, "")):
            raise _outside(where, f"{path.parent} is a link to {true}")
        return path

    def files(self, pattern: str) -> list[Path]:
        """Return the sorted files in the scene's own folder that match, or [] if unreadable."""
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
    """Return the first folder that all names share, or `.` if they do not share a folder."""
    first = {PurePosixPath(name).parts[:-1][:1] for name in names}
    return first.pop()[0] if len(first) == 1 and first != {()} else "."


def place_of(name: str) -> str:
    """Return a name without the folders that only separate training from held-out views."""
    parts = PurePosixPath(name).parts
    kept = [part for part in parts[:-1] if part.lower() not in SPLIT_FOLDERS]
    return "/".join((*kept, parts[-1]))

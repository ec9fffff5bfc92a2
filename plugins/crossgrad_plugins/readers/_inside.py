"""Names of files within a scene: none leads out of its folder; links are what they stand for.

docs/reliability.md has the rule and its reasons.
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

    @cached_property
    def _files(self) -> list[str]:
        """Paths of all files below the scene."""
        tree = ((PurePosixPath(below), files) for below, _, files in walked(self.scene))
        return [(below / file).as_posix() for below, files in tree for file in files]

    @cached_property
    def photos(self) -> FileNames:
        """The photos of the scene, to be found by the end of their path."""
        return FileNames(name for name in self._files if kind_of(name) == PHOTO)

    @cached_property
    def masks(self) -> FileNames:
        """The masks of the scene, likewise."""
        return FileNames(name for name in self._files if kind_of(name) == MASK)

    @cached_property
    def points(self) -> FileNames:
        """The point files of the scene, likewise."""
        return FileNames(name for name in self._files if kind_of(name) == POINTS)

    def name(self, text: str, where: object, base: str = "") -> str:
        """A name relative to the folder `base` of the scene, as a plain one below the scene.

        Raises:
            UserError: It leads out of the scene, or no file can have it.
        """
        if not is_possible_name(text):
            raise _impossible(where, text)
        plain = self._plain(text, base)
        if plain is None:
            raise _outside(where, repr(text))
        return plain

    def found(self, text: str, where: object, base: str, files: FileNames) -> str:
        """Like `name`; a name of no file stands for the one whose path ends as the name does.

        Raises:
            UserError: There is no such file, and the name leads out of the scene.
        """
        plain = self._plain(text, base)
        if plain is None or not is_file(self.scene / plain):
            other = files.find(plain or text)
            # Suffix and case are left as they are: the photo is paired and noted later.
            if other is not None and (plain is None or not same_spelling(plain, other)):
                return other
        return self.name(text, where, base)

    def _plain(self, text: str, base: str) -> str | None:
        """A name as a plain one below the scene; None where it leads out of the scene."""
        slashed = text.replace("\\", "/")
        for root in (os.path.abspath(self.scene), self._true):
            if slashed.startswith(os.path.join(root, "")):
                slashed, base = os.path.relpath(slashed, root), ""
        plain = posixpath.normpath(posixpath.join(base, slashed))
        leads_out = is_absolute(slashed) or plain in {".", ".."} or plain.startswith("../")
        return None if leads_out else plain

    def file(self, name: str, where: object) -> Path:
        """The file of a plain name, there or not; may be a link, for folders that are made of them.

        Photos and masks need no such check: a folder of them may lie anywhere, and what is no photo
        is refused.

        Raises:
            UserError: A folder on the way is a link that leads out of the scene.
        """
        path = self.scene / name
        true = os.path.realpath(path.parent)
        if true != self._true and not true.startswith(os.path.join(self._true, "")):
            raise _outside(where, f"{path.parent} is a link to {true}")
        return path

    def files(self, pattern: str) -> list[Path]:
        """The files of the scene's own folder that fit a pattern, sorted; none if unreadable."""
        try:
            return sorted(path for path in self.scene.glob(pattern) if path.is_file())
        except OSError:
            return []


def _outside(where: object, found: str) -> UserError:
    return UserError(
        "a file name leads out of the scene",
        where=where,
        expected="a file below the scene's folder, relative to it",
        found=found,
        todo="copy the file into the scene and mend the name, or name the folder that holds "
        "everything as the scene",
    )


def _impossible(where: object, text: str) -> UserError:
    return UserError(
        "a name that no file can have",
        where=where,
        expected=f"UTF-8 without control characters, at most {LONGEST_PART} bytes for a file or "
        f"folder and {LONGEST_NAME} in all",
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

"""Finding the file of every posed photo by name."""

import os
from collections.abc import Collection, Iterator
from dataclasses import replace
from pathlib import Path, PurePosixPath

from crossgrad_core.errors import UserError
from crossgrad_core.scene.file_kinds import IMAGES, PHOTO, kind_of
from crossgrad_core.scene.file_names import FileNames, Pairs, is_absolute
from crossgrad_core.system.input_files import is_file

_REDUCED = (2, 4, 8)


class PhotoFolder:
    """The photos below one folder, found by name.

    Args:
        path: The folder; need not be there.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.names = tuple(sorted(_list_photos(path)))

    def pair(self, names: Collection[str]) -> Pairs:
        """Find the photo of each posed image; see `FileNames`.

        Args:
            names: What the poses call the photos.
        """
        there = {name: name for name in names if self._holds(name)}
        rest = [name for name in names if name not in there]
        if not rest:
            return Pairs(there, {})
        files = FileNames(self.names, aside=lambda name: kind_of(name) is not PHOTO)
        pairs = files.pair(rest, there)
        return replace(pairs, files={**there, **pairs.files})

    def _holds(self, name: str) -> bool:
        """Whether a file of that name is there, whatever its suffix says."""
        inside = not is_absolute(name) and ".." not in PurePosixPath(name).parts
        return inside and is_file(self.path / name)


def find_photo_folders(images: Path) -> list[PhotoFolder]:
    """The photo folders that are there: full size first, then `<images>_2`, `_4`, `_8`.

    Raises:
        UserError: None is there.
    """
    paths = [images, *(images.with_name(f"{images.name}_{n}") for n in _REDUCED)]
    folders = [PhotoFolder(path) for path in paths if path.is_dir()]
    if not folders:
        beside = sorted(p.name for p in images.parent.iterdir() if p.is_dir())
        raise UserError(
            "the scene has no folder of photos",
            where=images,
            found="a file" if images.exists() else f"folders {', '.join(beside) or '(none)'}",
            todo=f"put the photos into {images.name}/, or name their folder",
        )
    return folders


def walked(folder: Path) -> Iterator[tuple[str, list[str], list[str]]]:
    """Folders at and below a folder, then those behind its links to folders, each once.

    Links behind links are not followed, nor one that leads to where the folder itself lies.

    Yields:
        The path below the folder with forward slashes (`.` for itself), the names of its folders,
        of which those that are taken out of the list are not looked into, and of its files.
    """
    seen: set[str] = set()
    links: list[Path] = []
    for below, folders, files in _tree(folder, folder, seen):
        yield below, folders, files
        places = (folder / below / name for name in sorted(folders))
        links += [place for place in places if place.is_symlink()]
    for link in links:
        if link.resolve() not in folder.resolve().parents:
            yield from _tree(folder, link, seen)


def _tree(folder: Path, start: Path, seen: set[str]) -> Iterator[tuple[str, list[str], list[str]]]:
    for base, folders, files in os.walk(start):
        place = os.path.realpath(base)
        if place in seen:
            folders.clear()
            continue
        seen.add(place)
        yield Path(base).relative_to(folder).as_posix(), folders, files


def _list_photos(folder: Path) -> list[str]:
    """Names of all photos below a folder, with forward slashes."""
    names: list[str] = []
    for below, _, files in walked(folder):
        prefix = "" if below == "." else below + "/"
        names += [prefix + f for f in files if os.path.splitext(f)[1].lower() in IMAGES]
    return names

"""Finding the file of every posed photo, and of its mask, by name."""

import os
import unicodedata
from collections import defaultdict
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath

from crossgrad_core.errors import UserError
from crossgrad_core.scene.heif import SUFFIXES
from crossgrad_core.scene.wording import name_some
from crossgrad_core.system.input_files import is_file

_SUFFIXES = frozenset(
    {
        ".avif",
        ".bmp",
        ".gif",
        ".jp2",
        ".jpeg",
        ".jpg",
        ".pgm",
        ".png",
        ".ppm",
        ".tif",
        ".tiff",
        ".webp",
    }
    | {*SUFFIXES}
)
_REDUCED = (2, 4, 8)


class PhotoFolder:
    """The photos below one folder, found by name.

    Args:
        path: The folder; need not be there.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.names = _list_photos(path)
        self._exact = frozenset(self.names)
        self._loose: Mapping[str, list[str]] = defaultdict(list)
        for name in self.names:
            self._loose[_fold(name)].append(name)

    def find(self, name: str, posed: Container[str]) -> Path | None:
        """The photo of that name; failing that, the only one that differs in suffix or case.

        Args:
            name: What the pose calls the photo.
            posed: All names with a pose: their own photos stand in for no other.
        """
        if name in self._exact or is_file(self.path / name):
            return self.path / name
        alike = [other for other in self._loose.get(_fold(name), ()) if other not in posed]
        return self.path / alike[0] if len(alike) == 1 else None

    def others(self, used: Iterable[Path]) -> list[str]:
        """Names of the photos that are not among `used`."""
        known = set(used)
        return [name for name in self.names if self.path / name not in known]


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


def mask_names(name: str) -> tuple[str, ...]:
    """What the mask of a photo may be called in a folder of masks, the first that is there.

    `aerial/0001.jpg` has the mask `aerial/0001.jpg.png` (COLMAP), `aerial/0001.png`,
    `aerial/0001_mask.png` (Metashape) or `aerial/0001.jpg`.
    """
    stem = str(PurePosixPath(name).with_suffix(""))
    return f"{name}.png", f"{stem}.png", f"{stem}_mask.png", name


def find_mask(folder: Path, name: str) -> Path | None:
    """The mask of a photo; None where it has none."""
    return next(filter(is_file, (folder / each for each in mask_names(name))), None)


def find_mask_folder(option: Path | None, root: Path) -> Path | None:
    """The mask folder: the option's, as given or within the scene; else `<scene>/masks`, if any.

    Raises:
        UserError: The option names a folder that is not there.
    """
    if option is None:
        return root / "masks" if (root / "masks").is_dir() else None
    for folder in (option, root / option):
        if folder.is_dir():
            return folder
    raise UserError(
        "the mask folder is not there",
        where=option,
        todo="name a folder, as it is or within the scene: --set reading.masks=FOLDER",
    )


def check_masks(folder: Path, option: Path | None, found: int, names: Sequence[str]) -> None:
    """Refuses a mask folder that was asked for and fits no photo.

    Raises:
        UserError: No photo has a mask in it.
    """
    if option is None or found:
        return
    there = PhotoFolder(folder).names
    raise UserError(
        "no photo has a mask in the mask folder",
        where=folder,
        expected=f"{names[0]}.png for the photo {names[0]}",
        found=name_some(there) or "no mask",
        todo="name the masks after their photos, or leave reading.masks out",
    )


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


def _list_photos(folder: Path) -> tuple[str, ...]:
    """Names of all photos below a folder, sorted, with forward slashes."""
    names = []
    for below, _, files in walked(folder):
        prefix = "" if below == "." else below + "/"
        names += [prefix + f for f in files if os.path.splitext(f)[1].lower() in _SUFFIXES]
    return tuple(sorted(names))


def _fold(name: str) -> str:
    """What two spellings of one photo's name share: neither suffix, case nor Unicode form."""
    stem = str(PurePosixPath(name).with_suffix(""))
    return unicodedata.normalize("NFC", stem).casefold()

"""Match photos and masks with files by their names."""

import os
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Final

from crossgrad_core.errors import UserError
from crossgrad_core.scene.photos.file_names import (
    IMAGES,
    PHOTO,
    FileNames,
    Pairs,
    is_absolute,
    kind_of,
    same_spelling,
    without_suffix,
)
from crossgrad_core.scene.raw import RawScene
from crossgrad_core.scene.wording import count, name_some
from crossgrad_core.system.input_files import is_file

_REDUCED = (2, 4, 8)
_DEFAULT: Final = "masks"
_WORD: Final = "(mask|masks|matte|alpha|seg|segmentation|silhouette)"
_DECORATION: Final = re.compile(rf"^{_WORD}[ ._-]+|[ ._-]+{_WORD}$", re.IGNORECASE)


class PhotoFolder:
    """The photos below a folder, which can be found by their names.

    Args:
        path: Path of the folder; the folder may be missing.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.names = tuple(sorted(_list_photos(path)))

    def pair(self, names: Collection[str]) -> Pairs:
        """Find the photo of each posed image, as described in `FileNames`.

        Args:
            names: Names of the images in the pose file.
        """
        there = {name: name for name in names if self._holds(name)}
        rest = [name for name in names if name not in there]
        if not rest:
            return Pairs(there, {})
        files = FileNames(self.names, aside=lambda name: kind_of(name) is not PHOTO)
        pairs = files.pair(rest, there)
        return replace(pairs, files={**there, **pairs.files})

    def _holds(self, name: str) -> bool:
        """Return True if a file with exactly this name exists; any suffix is allowed."""
        inside = not is_absolute(name) and ".." not in PurePosixPath(name).parts
        return inside and is_file(self.path / name)


def find_photo_folders(images: Path) -> list[PhotoFolder]:
    """Return the existing photo folders: full-size photos first, then `<images>_2`, `_4`, `_8`.

    Raises:
        UserError: No photo folder exists.
    """
    paths = [images, *(images.with_name(f"{images.name}_{n}") for n in _REDUCED)]
    folders = [PhotoFolder(path) for path in paths if path.is_dir()]
    if not folders:
        beside = sorted(p.name for p in images.parent.iterdir() if p.is_dir())
        raise UserError(
            "the scene has no folder of photos",
            where=images,
            found="a file" if images.exists() else f"folders {', '.join(beside) or '(none)'}",
            todo=f"put the photos into {images.name}/, or name their folder "
            "(COLMAP: --set reader.images=FOLDER)",
        )
    return folders


def walked(folder: Path) -> Iterator[tuple[str, list[str], list[str]]]:
    """Walk a folder, and then the folders that its links point to. Each folder is visited once.

    Links inside a linked folder are not followed. A link to a parent folder of `folder` is not
    followed.

    Yields:
        The path relative to the folder with forward slashes (`.` for the folder itself), the names
        of its subfolders, and the names of its files. A caller can remove subfolders from the list
        to skip these subfolders.
    """
    seen: set[str] = set()
    links: list[Path] = []
    for below, folders, files in _tree(folder, folder, seen):
        yield below, folders, files
        places = (folder / below / name for name in sorted(folders))
        links += [path for path in places if path.is_symlink()]
    for link in links:
        if link.resolve() not in folder.resolve().parents:
            yield from _tree(folder, link, seen)


def _tree(folder: Path, start: Path, seen: set[str]) -> Iterator[tuple[str, list[str], list[str]]]:
    for base, folders, files in os.walk(start):
        real_path = os.path.realpath(base)
        if real_path in seen:
            folders.clear()
            continue
        seen.add(real_path)
        yield Path(base).relative_to(folder).as_posix(), folders, files


def _list_photos(folder: Path) -> list[str]:
    """Return the paths of all photos below a folder, with forward slashes."""
    names: list[str] = []
    for below, _, files in walked(folder):
        prefix = "" if below == "." else below + "/"
        names += [prefix + f for f in files if os.path.splitext(f)[1].lower() in IMAGES]
    return names


def mask_names(name: str) -> tuple[str, ...]:
    """Return the possible names of a photo's mask, in order of priority.

    `aerial/0001.jpg` can have the mask `aerial/0001.jpg.png` (COLMAP), `aerial/0001.png`,
    `aerial/0001_mask.png` (Metashape) or `aerial/0001.jpg`.
    """
    stem = str(PurePosixPath(name).with_suffix(""))
    return f"{name}.png", f"{stem}.png", f"{stem}_mask.png", name


def find_mask(folder: Path, name: str) -> Path | None:
    """Return the path of a photo's mask; None if the photo has no mask."""
    return next(filter(is_file, (folder / mask_name for mask_name in mask_names(name))), None)


def pair_masks(folder: Path, names: Sequence[str]) -> dict[str, Path]:
    """Find the masks of photos, as far as masks exist.

    The names from `mask_names` have priority. After that, folders, suffix and letter case may
    differ. Finally, a word such as `mask` may precede or follow the photo's name.

    Args:
        folder: Folder of the masks.
        names: Names of the photos.
    """
    masks = {name: path for name in names if (path := find_mask(folder, name)) is not None}
    there = frozenset(PhotoFolder(folder).names) if len(masks) < len(names) else frozenset()
    for called in (without_suffix, _undecorated):
        files = there - {path.relative_to(folder).as_posix() for path in masks.values()}
        pairs = FileNames(files, called).pair([name for name in names if name not in masks])
        masks |= {name: folder / file for name, file in pairs.files.items()}
    return masks


def find_mask_folder(option: Path | None, root: Path) -> Path | None:
    """Return the mask folder.

    The mask folder is the folder of the option, as a path or relative to the scene. Without the
    option, the mask folder is `<scene>/masks`, if this folder exists.

    Raises:
        UserError: The folder that the option names does not exist.
    """
    if option is None:
        return next(_default_folders(root), None)
    for folder in (option, root / option):
        if folder.is_dir():
            return folder
    raise UserError(
        "the mask folder does not exist",
        where=option,
        todo="give the folder as a path, or as a path below the scene folder: --set "
        "data.masks=FOLDER",
    )


def check_masks(folder: Path, option: Path | None, found: int, names: Sequence[str]) -> None:
    """Raise an error if a mask folder contains no mask for any photo.

    An empty default folder is accepted.

    Raises:
        UserError: The folder contains no mask for any photo.
    """
    there = PhotoFolder(folder).names if not found else ()
    if found or (option is None and not there):
        return
    raise UserError(
        "the mask folder contains no mask for any photo",
        where=folder,
        expected=f"{' or '.join(dict.fromkeys(mask_names(names[0])))} for the photo {names[0]}",
        found=name_some(there) or "no mask",
        todo="name the masks after their photos, or leave data.masks out"
        if option
        else "name the masks after their photos, or rename the folder to train without masks",
    )


def _default_folders(root: Path) -> Iterator[Path]:
    """Yield `<scene>/masks`, and folders whose name differs from `masks` only in letter case."""
    if (root / _DEFAULT).is_dir():
        yield root / _DEFAULT
    alike = (path for path in sorted(root.iterdir()) if path.name.casefold() == _DEFAULT)
    yield from (path for path in alike if path.is_dir())


def _undecorated(name: str) -> str:
    """Return the name of a mask without a word such as `mask` at the start or end."""
    path = PurePosixPath(without_suffix(name))
    stem = without_suffix(_DECORATION.sub("", path.name))
    return str(path.with_name(stem)) if stem else str(path)


def with_photo_names(raw: RawScene) -> RawScene:
    """Return the scene with each image named by the path of its photo below `images`.

    Programs may write absolute paths, or paths relative to another folder. A name is unchanged if
    it differs from the name of its photo only in suffix or letter case.

    Raises:
        UserError: The photo folder is missing, or an absolute path matches several photos.
    """
    names = [view.name for view in raw.views]
    if all(not is_absolute(name) and is_file(raw.images / name) for name in names):
        return raw
    pairs = find_photo_folders(raw.images)[0].pair(names)
    _check_absolute(raw, pairs.ambiguous)
    moved = {name: file for name, file in pairs.files.items() if not same_spelling(name, file)}
    groups = (
        (moved, "found by the end of their path", "{0} is {1}"),
        (pairs.ambiguous, "without a photo: their name matches several photos", "{0} ({1})"),
    )
    notes = [
        f"photos: {count(len(which), 'posed image')} {what}: "
        + name_some([form.format(name, _listed(files)) for name, files in sorted(which.items())])
        for which, what, form in groups
        if which
    ]
    views = tuple(replace(view, name=moved.get(view.name, view.name)) for view in raw.views)
    if raw.split is not None:
        train, test = (
            frozenset(moved.get(name, name) for name in split_names) for split_names in raw.split
        )
        raw = replace(raw, split=(train, test))
    return replace(raw, views=views, notes=(*raw.notes, *notes))


def _listed(files: str | Sequence[str]) -> str:
    return files if isinstance(files, str) else " or ".join(files)


def _check_absolute(raw: RawScene, ambiguous: Mapping[str, Sequence[str]]) -> None:
    names = [name for name in ambiguous if is_absolute(name)]
    if names:
        raise UserError(
            "an image name of the model matches several photos",
            where=raw.images,
            expected="a path below the image folder, or the end of a path that only one photo has",
            found=f"{names[0]}, which can be {name_some(ambiguous[names[0]])}",
            todo="rename the image in the model, so that its path equals the path of the photo",
        )

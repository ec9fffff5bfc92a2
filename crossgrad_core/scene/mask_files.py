"""Finding the mask of every photo by name."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import Final

from crossgrad_core.errors import UserError
from crossgrad_core.scene.file_names import FileNames, without_suffix
from crossgrad_core.scene.photo_files import PhotoFolder
from crossgrad_core.scene.wording import name_some
from crossgrad_core.system.input_files import is_file

_DEFAULT: Final = "masks"
_WORD: Final = "(mask|masks|matte|alpha|seg|segmentation|silhouette)"
_DECORATION: Final = re.compile(rf"^{_WORD}[ ._-]+|[ ._-]+{_WORD}$", re.IGNORECASE)


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


def pair_masks(folder: Path, names: Sequence[str]) -> dict[str, Path]:
    """Find the mask of each photo that has one.

    Names of `mask_names` come first. Then other folders, suffixes and letter cases are tried, and
    last names with a word such as `mask` before or after the photo's name.

    Args:
        folder: The folder of the masks.
        names: The photos.
    """
    masks = {name: path for name in names if (path := find_mask(folder, name)) is not None}
    there = frozenset(PhotoFolder(folder).names) if len(masks) < len(names) else frozenset()
    for called in (without_suffix, _undecorated):
        files = there - {path.relative_to(folder).as_posix() for path in masks.values()}
        pairs = FileNames(files, called).pair([name for name in names if name not in masks])
        masks |= {name: folder / file for name, file in pairs.files.items()}
    return masks


def find_mask_folder(option: Path | None, root: Path) -> Path | None:
    """The mask folder: the option's, as given or within the scene; else `<scene>/masks`, if any.

    Raises:
        UserError: The option names a folder that is not there.
    """
    if option is None:
        return next(_default_folders(root), None)
    for folder in (option, root / option):
        if folder.is_dir():
            return folder
    raise UserError(
        "the mask folder is not there",
        where=option,
        todo="name a folder, as it is or within the scene: --set data.masks=FOLDER",
    )


def check_masks(folder: Path, option: Path | None, found: int, names: Sequence[str]) -> None:
    """Refuse a mask folder that fits no photo; by default an empty folder is no mask folder.

    Raises:
        UserError: No photo has a mask in it.
    """
    there = PhotoFolder(folder).names if not found else ()
    if found or (option is None and not there):
        return
    raise UserError(
        "no photo has a mask in the mask folder",
        where=folder,
        expected=f"{' or '.join(dict.fromkeys(mask_names(names[0])))} for the photo {names[0]}",
        found=name_some(there) or "no mask",
        todo="name the masks after their photos, or leave data.masks out"
        if option
        else "name the masks after their photos, or rename the folder to train without masks",
    )


def _default_folders(root: Path) -> Iterator[Path]:
    """`<scene>/masks`, and folders whose name differs in letter case only."""
    if (root / _DEFAULT).is_dir():
        yield root / _DEFAULT
    alike = (path for path in sorted(root.iterdir()) if path.name.casefold() == _DEFAULT)
    yield from (path for path in alike if path.is_dir())


def _undecorated(name: str) -> str:
    """The name of a mask without a word such as `mask` at its start or end."""
    path = PurePosixPath(without_suffix(name))
    stem = without_suffix(_DECORATION.sub("", path.name))
    return str(path.with_name(stem)) if stem else str(path)

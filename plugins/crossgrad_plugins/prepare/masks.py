"""Masks of photos: search, checks, and conversion to the orientation of the photo."""

import os
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.commands import UserError
from crossgrad_core.plugin import is_file
from crossgrad_core.scene.photos.decode import decode_mask, decode_photo, turn
from crossgrad_core.scene.photos.photo_files import PhotoFolder, mask_names, pair_masks
from crossgrad_core.scene.photos.shapes import check_mask, is_turned
from crossgrad_core.scene.wording import count, name_some
from crossgrad_plugins.prepare.plan import LeftOut, Photo, digest_of

#: Name of folders that contain masks. A file next to a photo is a mask if its name without suffix
#: ends with one of these texts.
_MASKS: Final = "masks"
_ENDS: Final = ("_mask", ".mask")
#: A pixel does not count if its mask value or its opacity is below this level.
HALF: Final = 128
#: EXIF orientations that rotate a photo by a quarter turn -> orientations that undo the rotation.
_BACK: Final = {5: 5, 6: 8, 7: 7, 8: 6}


@dataclass(frozen=True)
class Sorted:
    """The image files in a folder, divided into photos and masks by their names.

    Attributes:
        photos: Names of the photos.
        masks: Name of a photo with a mask -> its mask.
        left_out: Mask folders to report, and masks that belong to no photo.
    """

    photos: tuple[str, ...]
    masks: Mapping[str, Path]
    left_out: tuple[LeftOut, ...]


def sorted_out(root: Path, files: Sequence[str], wanted: Path | None) -> Sorted:
    """Divide image files into photos and masks.

    Args:
        root: Folder of the photos.
        files: Names of the image files in the folder.
        wanted: Folder of the masks, or None to search for masks. Masks are searched in three
            places: in the folder `masks`; in other folders named `masks` whose files match photos
            beside the folder; and beside the photos.

    Raises:
        UserError: The folder is missing, or contains no mask for any photo.
    """
    if wanted is not None and not wanted.is_dir():
        raise UserError(
            "the mask folder does not exist",
            where=wanted,
            todo="check the path, or leave --masks out",
        )
    folders = _folders(root, files, wanted)
    inside = frozenset[str]().union(*folders.values())
    rest = [name for name in files if name not in inside]
    beside = [name for name in rest if PurePosixPath(name).stem.lower().endswith(_ENDS)]
    photos = [name for name in rest if name not in frozenset(beside)]
    if wanted is None:
        masks = _usual(root, photos, folders)
    else:
        masks = _wanted(root, photos, wanted)
        # Remove masks from the list of photos, because masks may be in the folder of the photos.
        taken = frozenset(map(os.path.realpath, masks.values()))
        photos = [name for name in photos if os.path.realpath(root / name) not in taken]
        masks = {name: masks[name] for name in photos if name in masks}
        _check_some(wanted, photos, masks)
    left_out = *_tell_folders(root, folders, photos, wanted), *_strays(beside, photos)
    return Sorted(tuple(photos), masks, left_out)


def _folders(root: Path, files: Sequence[str], wanted: Path | None) -> dict[str, list[str]]:
    """Return the mask folders inside the folder of photos, with the names of their files.

    Mask folders are the requested folder, the folder `masks` at the top, and every other folder
    `masks` in which most files have the names of photos beside the folder.
    """
    asked = _asked(root, wanted)

    @cache
    def is_asked(folder: str) -> bool:
        return asked is not None and os.path.realpath(root / folder) == asked

    by_folder = defaultdict[str, list[str]](list)
    for name in files:
        above = [parent.as_posix() for parent in PurePosixPath(name).parents][-2::-1]
        masks = (
            parent for parent in above if is_asked(parent) or PurePosixPath(parent).name == _MASKS
        )
        by_folder[next(masks, "")].append(name)
    others = by_folder.pop("", [])
    return {
        folder: inside
        for folder, inside in by_folder.items()
        if folder == _MASKS
        or is_asked(folder)
        or 2 * len(_of_photos(root, folder, inside, others)) > len(inside)
    }


def _asked(root: Path, wanted: Path | None) -> str | None:
    """Return the resolved path of the requested folder; None if it is the folder of photos."""
    asked = None if wanted is None else os.path.realpath(wanted)
    return None if asked == os.path.realpath(root) else asked


def _below(folder: str, name: str) -> str | None:
    """Return a photo's name relative to the parent of a mask folder; None if it is not inside."""
    base = PurePosixPath(folder).parent.as_posix()
    if base == ".":
        return name
    return name.removeprefix(f"{base}/") if name.startswith(f"{base}/") else None


def _of_photos(root: Path, folder: str, inside: Iterable[str], photos: Sequence[str]) -> set[str]:
    """Return the files of a mask folder that have the names of photos."""
    below = (_below(folder, name) for name in photos)
    named = {f"{folder}/{mask}" for name in below if name is not None for mask in mask_names(name)}
    named |= {path.relative_to(root).as_posix() for path in _paired(root, folder, photos).values()}
    return named.intersection(inside)


def _paired(root: Path, folder: str, photos: Sequence[str]) -> dict[str, Path]:
    """Return the mask of each photo, for a mask folder beside the photos."""
    below = {name: path for name in photos if (path := _below(folder, name)) is not None}
    pairs = pair_masks(root / folder, [*below.values()])
    return {name: pairs[path] for name, path in below.items() if path in pairs}


def _usual(root: Path, photos: Sequence[str], folders: Iterable[str]) -> dict[str, Path]:
    """Return the masks that are found without a requested folder."""
    stems = {name: str(PurePosixPath(name).with_suffix("")) for name in photos}
    beside = {name: [root / f"{stem}{end}.png" for end in _ENDS] for name, stem in stems.items()}
    masks = _first(root, beside)
    for folder in sorted(
        folders, key=lambda mask_folder: (mask_folder != _MASKS, mask_folder), reverse=True
    ):
        pairs = _paired(root, folder, photos)
        masks |= {name: path.absolute() for name, path in pairs.items()}
    return masks


def _wanted(root: Path, photos: Sequence[str], folder: Path) -> dict[str, Path]:
    """Return the masks in the requested folder."""
    masks = _first(root, {name: [folder / mask for mask in mask_names(name)] for name in photos})
    if os.path.realpath(folder) == os.path.realpath(root):
        return masks
    photo_files = frozenset(os.path.realpath(root / name) for name in photos)
    pairs = pair_masks(folder, photos)
    return {
        n: p.absolute() for n, p in pairs.items() if os.path.realpath(p) not in photo_files
    } | masks


def _first(root: Path, places: Mapping[str, Iterable[Path]]) -> dict[str, Path]:
    """Return for each photo the first of its candidate masks that exists.

    A photo is never its own mask.
    """
    masks: dict[str, Path] = {}
    for name, paths in places.items():
        photo_file = os.path.realpath(root / name)
        there = (path for path in paths if is_file(path) and os.path.realpath(path) != photo_file)
        mask = next(there, None)
        if mask is not None:
            masks[name] = mask.absolute()
    return masks


def _check_some(wanted: Path, photos: Sequence[str], masks: Mapping[str, Path]) -> None:
    if masks or not photos:
        return
    names = ", ".join(dict.fromkeys(mask_names(photos[0])))
    raise UserError(
        "the mask folder contains no mask for any photo",
        where=wanted,
        expected=f"one of {names} for the photo {photos[0]}",
        found=name_some(PhotoFolder(wanted).names) or "no image",
        todo="name the masks after their photos, including their folders, or leave --masks out",
    )


def _tell_folders(
    root: Path, folders: Mapping[str, Sequence[str]], photos: Sequence[str], wanted: Path | None
) -> Iterator[LeftOut]:
    """Yield messages about mask folders.

    The folder `masks` is reported only if it contains other files.
    """
    asked = _asked(root, wanted)
    for folder, inside in sorted(folders.items()):
        named = _of_photos(root, folder, inside, photos)
        strays = [name for name in inside if name not in named]
        if asked is not None and os.path.realpath(root / folder) == asked:
            yield LeftOut(
                name=name_some([f"{folder}/"]), why="the folder of masks (--masks), not of photos"
            )
        elif strays:
            why = f"masks; {count(len(strays), 'file')} without a photo: {name_some(strays)}"
            yield LeftOut(name=name_some([f"{folder}/"]), why=why)
        elif folder != _MASKS:
            yield LeftOut(name=name_some([f"{folder}/"]), why="masks of the photos next to it")


def _strays(beside: Iterable[str], photos: Iterable[str]) -> Iterator[LeftOut]:
    """Yield files beside the photos that are named like masks but belong to no photo."""
    stems = {str(PurePosixPath(name).with_suffix("")) for name in photos}
    masks = {f"{stem}{end}" for stem in stems for end in _ENDS}
    for name in beside:
        path = PurePosixPath(name)
        if str(path.with_suffix("")) not in masks:
            why = "named like a mask, but without a photo: rename it if it is a photo"
        elif path.suffix != ".png":
            why = "the name of a mask next to its photo must end in .png"
        else:
            continue
        yield LeftOut(name=name_some([name]), why=why)


def with_mask(photo: Photo, mask: Path) -> Photo:
    """Return the photo with its mask.

    The mask is decoded here, so that a damaged mask is found early.

    Raises:
        UserError: The mask is damaged, or its aspect ratio fits neither the stored nor the
            displayed photo.
    """
    check_mask(mask, (photo.width, photo.height), may_turn=photo.orientation in _BACK)
    decode_mask(mask)
    return photo.model_copy(update={"mask": str(mask), "mask_sha256": digest_of(mask)})


def counting_pixels(root: Path, photo: Photo) -> NDArray[np.uint8] | None:
    """Return [H, W] with 255 for pixels that count, by mask and by transparency.

    If all pixels count, return None.

    Raises:
        UserError: The photo or its mask is damaged, or the mask does not fit any more.
    """
    kept = None if photo.mask is None else _as_stored(photo, Path(photo.mask))
    if not photo.transparent:
        return kept
    _, alpha = decode_photo(root / photo.name)
    if alpha is None:
        return kept
    opaque = np.where(alpha >= HALF, 255, 0).astype(np.uint8)
    return opaque if kept is None else np.minimum(kept, opaque)


def _as_stored(photo: Photo, path: Path) -> NDArray[np.uint8]:
    """Return a mask [H, W] in the size and orientation of the stored photo."""
    from PIL import Image

    size = photo.width, photo.height
    check_mask(path, size, may_turn=photo.orientation in _BACK)
    mask = decode_mask(path)
    height, width = mask.shape
    if is_turned((width, height), size):
        mask = turn(mask, _BACK[photo.orientation])
    whole = Image.fromarray(np.ascontiguousarray(mask))
    return np.asarray(whole.resize(size, Image.Resampling.NEAREST))

"""Masks of photos: pairing with photos, checks, and pixels in the orientation of the photo."""

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

#: Folders with this name contain masks. A file next to a photo is a mask if its stem has one of
#: these endings.
_MASKS: Final = "masks"
_ENDS: Final = ("_mask", ".mask")
#: If a mask or the opacity of a pixel has a level below this, the pixel does not count.
HALF: Final = 128
#: EXIF orientations that rotate a photo by a quarter turn -> orientations that undo this rotation.
_BACK: Final = {5: 5, 6: 8, 7: 7, 8: 6}


@dataclass(frozen=True)
class Sorted:
    """The image files below a folder, separated into photos and masks by their names.

    Attributes:
        photos: Names of the photos.
        masks: Name of a photo with a mask -> its mask.
        left_out: Reported mask folders, and masks that match no photo.
    """

    photos: tuple[str, ...]
    masks: Mapping[str, Path]
    left_out: tuple[LeftOut, ...]


def sorted_out(root: Path, files: Sequence[str], wanted: Path | None) -> Sorted:
    """Separate photos from masks.

    Args:
        root: Folder of the photos.
        files: Names of the image files below it.
        wanted: Folder of the masks. If None, masks are searched in three places: in the folder
            `masks`, in other folders named `masks` whose files match photos next to them, and next
            to the photos.

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
        # Remove masks from the list of photos, because the mask folder may be the folder of the
        # photos.
        taken = frozenset(map(os.path.realpath, masks.values()))
        photos = [name for name in photos if os.path.realpath(root / name) not in taken]
        masks = {name: masks[name] for name in photos if name in masks}
        _check_some(wanted, photos, masks)
    left_out = *_tell_folders(root, folders, photos, wanted), *_strays(beside, photos)
    return Sorted(tuple(photos), masks, left_out)


def _folders(root: Path, files: Sequence[str], wanted: Path | None) -> dict[str, list[str]]:
    """Return the mask folders among the photos, with the names of their files.

    The mask folders are the requested folder, the folder `masks` at the top, and every other folder
    `masks` in which most files are named after photos next to the folder.
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
    """Return the real path of the requested folder, or None if it is the folder of the photos."""
    asked = None if wanted is None else os.path.realpath(wanted)
    return None if asked == os.path.realpath(root) else asked


def _below(folder: str, name: str) -> str | None:
    """Return a photo's name relative to a mask folder's parent, or None if the photo is outside."""
    base = PurePosixPath(folder).parent.as_posix()
    if base == ".":
        return name
    return name.removeprefix(f"{base}/") if name.startswith(f"{base}/") else None


def _of_photos(root: Path, folder: str, inside: Iterable[str], photos: Sequence[str]) -> set[str]:
    """Return the files of a mask folder that are named after photos."""
    below = (_below(folder, name) for name in photos)
    named = {f"{folder}/{mask}" for name in below if name is not None for mask in mask_names(name)}
    named |= {path.relative_to(root).as_posix() for path in _paired(root, folder, photos).values()}
    return named.intersection(inside)


def _paired(root: Path, folder: str, photos: Sequence[str]) -> dict[str, Path]:
    """Return the mask of each photo, for masks in a folder below `root` and photos next to it."""
    below = {name: path for name in photos if (path := _below(folder, name)) is not None}
    pairs = pair_masks(root / folder, [*below.values()])
    return {name: pairs[path] for name, path in below.items() if path in pairs}


def _usual(root: Path, photos: Sequence[str], folders: Iterable[str]) -> dict[str, Path]:
    """Return the default masks: in `masks`, in other folders named `masks`, or next to photos."""
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
    """Return the first existing file for each photo. A photo is never its own mask."""
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
    """Yield messages on mask folders; on `masks` itself only if it contains other files."""
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
    """Yield files among the photos that are named like masks but are not masks."""
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
    """Return the photo with its mask. The mask is decoded, so that damage is found early.

    Raises:
        UserError: The mask is damaged, or matches neither the stored nor the displayed proportions.
    """
    check_mask(mask, (photo.width, photo.height), may_turn=photo.orientation in _BACK)
    decode_mask(mask)
    return photo.model_copy(update={"mask": str(mask), "mask_sha256": digest_of(mask)})


def counting_pixels(root: Path, photo: Photo) -> NDArray[np.uint8] | None:
    """Return [H, W] with 255 for pixels that count by mask and transparency.

    Return None if all pixels count.

    Raises:
        UserError: The photo or its mask is damaged, or the mask no longer fits.
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
    """Return a mask [H, W] in the size of its stored photo, rotated back if it was rotated."""
    from PIL import Image

    size = photo.width, photo.height
    check_mask(path, size, may_turn=photo.orientation in _BACK)
    mask = decode_mask(path)
    height, width = mask.shape
    if is_turned((width, height), size):
        mask = turn(mask, _BACK[photo.orientation])
    whole = Image.fromarray(np.ascontiguousarray(mask))
    return np.asarray(whole.resize(size, Image.Resampling.NEAREST))

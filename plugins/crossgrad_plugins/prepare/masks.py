"""Masks of photos: which file is whose, whether it fits, and its pixels as the photo is stored."""

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

#: Folders of this name hold masks, and so do files beside the photos whose stem ends so.
_MASKS: Final = "masks"
_ENDS: Final = ("_mask", ".mask")
#: The level of a mask or of transparency below which a pixel does not count.
HALF: Final = 128
#: EXIF orientations by which a photo is shown turned by a quarter -> those that turn it back.
_BACK: Final = {5: 5, 6: 8, 7: 7, 8: 6}


@dataclass(frozen=True)
class Sorted:
    """The image files below a folder, told apart by their names.

    Attributes:
        photos: Names of the photos.
        masks: Name of a photo -> its mask, where it has one.
        left_out: Folders of masks where nobody may expect them, and masks of no photo.
    """

    photos: tuple[str, ...]
    masks: Mapping[str, Path]
    left_out: tuple[LeftOut, ...]


def sorted_out(root: Path, files: Sequence[str], wanted: Path | None) -> Sorted:
    """Tells photos from masks.

    Args:
        root: Folder of the photos.
        files: Names of the image files below it.
        wanted: Folder of the masks; None for `masks` below the photos, folders of this name with
            the masks of photos beside them, and files beside the photos.

    Raises:
        UserError: The folder is not there, or no photo has a mask in it.
    """
    if wanted is not None and not wanted.is_dir():
        raise UserError(
            "the mask folder is not there",
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
        # The folder may be that of the photos.
        taken = frozenset(map(os.path.realpath, masks.values()))
        photos = [name for name in photos if os.path.realpath(root / name) not in taken]
        masks = {name: masks[name] for name in photos if name in masks}
        _check_some(wanted, photos, masks)
    told = *_tell_folders(root, folders, photos, wanted), *_strays(beside, photos)
    return Sorted(tuple(photos), masks, told)


def _folders(root: Path, files: Sequence[str], wanted: Path | None) -> dict[str, list[str]]:
    """The folders of masks among the photos, with the names of their files.

    These are the one that was asked for, `masks` itself, and others of this name most of whose
    files are named after photos beside them.
    """
    asked = _asked(root, wanted)

    @cache
    def is_asked(folder: str) -> bool:
        return asked is not None and os.path.realpath(root / folder) == asked

    found = defaultdict[str, list[str]](list)
    for name in files:
        above = [each.as_posix() for each in PurePosixPath(name).parents][-2::-1]
        masks = (each for each in above if is_asked(each) or PurePosixPath(each).name == _MASKS)
        found[next(masks, "")].append(name)
    others = found.pop("", [])
    return {
        folder: inside
        for folder, inside in found.items()
        if folder == _MASKS
        or is_asked(folder)
        or 2 * len(_of_photos(root, folder, inside, others)) > len(inside)
    }


def _asked(root: Path, wanted: Path | None) -> str | None:
    """The true place of the folder that was asked for; None where it is the one of the photos."""
    asked = None if wanted is None else os.path.realpath(wanted)
    return None if asked == os.path.realpath(root) else asked


def _below(folder: str, name: str) -> str | None:
    """A photo's name below the folder that a folder of masks lies in; None where it is not."""
    base = PurePosixPath(folder).parent.as_posix()
    if base == ".":
        return name
    return name.removeprefix(f"{base}/") if name.startswith(f"{base}/") else None


def _of_photos(root: Path, folder: str, inside: Iterable[str], photos: Sequence[str]) -> set[str]:
    """Those files of a folder of masks that are named after photos."""
    below = (_below(folder, name) for name in photos)
    named = {f"{folder}/{each}" for name in below if name is not None for each in mask_names(name)}
    named |= {path.relative_to(root).as_posix() for path in _paired(root, folder, photos).values()}
    return named.intersection(inside)


def _paired(root: Path, folder: str, photos: Sequence[str]) -> dict[str, Path]:
    """The masks in a folder below `root`, of the photos beside it: photo -> mask."""
    below = {name: each for name in photos if (each := _below(folder, name)) is not None}
    found = pair_masks(root / folder, [*below.values()])
    return {name: found[each] for name, each in below.items() if each in found}


def _usual(root: Path, photos: Sequence[str], folders: Iterable[str]) -> dict[str, Path]:
    """The masks that are found without being asked for: in `masks`, other folders, or beside."""
    stems = {name: str(PurePosixPath(name).with_suffix("")) for name in photos}
    beside = {name: [root / f"{stem}{end}.png" for end in _ENDS] for name, stem in stems.items()}
    masks = _first(root, beside)
    for folder in sorted(folders, key=lambda each: (each != _MASKS, each), reverse=True):
        pairs = _paired(root, folder, photos)
        masks |= {name: path.absolute() for name, path in pairs.items()}
    return masks


def _wanted(root: Path, photos: Sequence[str], folder: Path) -> dict[str, Path]:
    """The masks in the folder that was asked for."""
    masks = _first(root, {name: [folder / each for each in mask_names(name)] for name in photos})
    if os.path.realpath(folder) == os.path.realpath(root):
        return masks
    own = frozenset(os.path.realpath(root / name) for name in photos)
    pairs = pair_masks(folder, photos)
    return {n: p.absolute() for n, p in pairs.items() if os.path.realpath(p) not in own} | masks


def _first(root: Path, places: Mapping[str, Iterable[Path]]) -> dict[str, Path]:
    """The first file that is there, for each photo that has one; no photo is a mask of itself."""
    found: dict[str, Path] = {}
    for name, paths in places.items():
        own = os.path.realpath(root / name)
        there = (each for each in paths if is_file(each) and os.path.realpath(each) != own)
        mask = next(there, None)
        if mask is not None:
            found[name] = mask.absolute()
    return found


def _check_some(wanted: Path, photos: Sequence[str], masks: Mapping[str, Path]) -> None:
    if masks or not photos:
        return
    names = ", ".join(dict.fromkeys(mask_names(photos[0])))
    raise UserError(
        "no photo has a mask in the mask folder",
        where=wanted,
        expected=f"one of {names} for the photo {photos[0]}",
        found=name_some(PhotoFolder(wanted).names) or "no image",
        todo="name the masks after their photos, folders included, or leave --masks out",
    )


def _tell_folders(
    root: Path, folders: Mapping[str, Sequence[str]], photos: Sequence[str], wanted: Path | None
) -> Iterator[LeftOut]:
    """What is said of folders of masks: not of `masks` itself, unless it holds other files."""
    asked = _asked(root, wanted)
    for folder, inside in sorted(folders.items()):
        named = _of_photos(root, folder, inside, photos)
        strays = [name for name in inside if name not in named]
        if asked is not None and os.path.realpath(root / folder) == asked:
            yield LeftOut(
                name=name_some([f"{folder}/"]), why="the folder of masks (--masks), not of photos"
            )
        elif strays:
            why = f"masks, but {count(len(strays), 'file')} of no photo: {name_some(strays)}"
            yield LeftOut(name=name_some([f"{folder}/"]), why=why)
        elif folder != _MASKS:
            yield LeftOut(name=name_some([f"{folder}/"]), why="masks of the photos beside it")


def _strays(beside: Iterable[str], photos: Iterable[str]) -> Iterator[LeftOut]:
    """Files among the photos that are named as masks, and are none."""
    stems = {str(PurePosixPath(name).with_suffix("")) for name in photos}
    masks = {f"{stem}{end}" for stem in stems for end in _ENDS}
    for name in beside:
        path = PurePosixPath(name)
        if str(path.with_suffix("")) not in masks:
            why = "named as a mask, but of no photo: rename it if it is one"
        elif path.suffix != ".png":
            why = "the name of a mask beside its photo has to end in .png"
        else:
            continue
        yield LeftOut(name=name_some([name]), why=why)


def with_mask(photo: Photo, mask: Path) -> Photo:
    """The photo with its mask, which is decoded once, so that a damaged one is known at once.

    Raises:
        UserError: It is damaged, or not in the proportion of the photo, stored or as it is shown.
    """
    check_mask(mask, (photo.width, photo.height), may_turn=photo.orientation in _BACK)
    decode_mask(mask)
    return photo.model_copy(update={"mask": str(mask), "mask_sha256": digest_of(mask)})


def counting_pixels(root: Path, photo: Photo) -> NDArray[np.uint8] | None:
    """[H, W] 255 where a pixel of a photo counts, by its mask and its transparency; None: all do.

    Raises:
        UserError: The photo or its mask is damaged, or does not fit any more.
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
    """[H, W] a mask in the size of its photo; one that was drawn on the turned photo is turned."""
    from PIL import Image

    size = photo.width, photo.height
    check_mask(path, size, may_turn=photo.orientation in _BACK)
    mask = decode_mask(path)
    height, width = mask.shape
    if is_turned((width, height), size):
        mask = turn(mask, _BACK[photo.orientation])
    whole = Image.fromarray(np.ascontiguousarray(mask))
    return np.asarray(whole.resize(size, Image.Resampling.NEAREST))

"""Choose the file, size and calibration of each view's photo.

Only the headers of files are read.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from crossgrad_core.contract.scene import Pinhole
from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.errors import UserError
from crossgrad_core.scene.calibration import Calibration
from crossgrad_core.scene.photos.decode import FULL_16_BIT, WHITES, brightest
from crossgrad_core.scene.photos.headers import PhotoHeader, read_header, read_quarter_turn
from crossgrad_core.scene.photos.photo_files import (
    PhotoFolder,
    check_masks,
    find_mask_folder,
    find_photo_folders,
    pair_masks,
)
from crossgrad_core.scene.photos.photo_notes import (
    note_kinds,
    note_links,
    note_memory,
    note_pairing,
    note_reductions,
    note_sizes,
    note_undistortion,
    note_unused,
)
from crossgrad_core.scene.photos.photos import PhotoSource
from crossgrad_core.scene.photos.shapes import check_mask, choose_reduction, is_scaled
from crossgrad_core.scene.raw import RawScene
from crossgrad_core.scene.wording import count, name_some

#: Photos in 16-bit files may contain values of fewer bits. Fewer bits are recognised if the largest
#: value reaches this share of a smaller range. The bit depth of darker photos is ambiguous.
_REACHED: Final = 0.8
#: If the largest value is above this number, the photos use all 16 bits.
_DARK: Final = WHITES[-2]
#: Number of photos that are decoded before their largest value is checked.
_AT_ONCE: Final = 8


def white_of(deep: Sequence[Path]) -> tuple[int, list[str]]:
    """Return the value of white in all 16-bit photos. Return a note if this value is not 65535.

    All photos share this value, which depends on the brightest pixel in all photos. Photos stay
    dark if their largest value matches neither the 16-bit range nor a smaller range.

    Args:
        deep: Paths of the 16-bit photos. Photos are decoded until the values of a photo reach the
            16-bit range.

    Raises:
        UserError: A photo is damaged.
    """
    top = 0 if deep else FULL_16_BIT
    with ThreadPoolExecutor() as pool:
        for start in range(0, len(deep), _AT_ONCE):
            top = max(top, *pool.map(brightest, deep[start : start + _AT_ONCE]))
            if top > _DARK:
                break
    if top > _DARK:
        return FULL_16_BIT, []
    white = next(white for white in WHITES if white >= top)
    photos = f"photos: {count(len(deep), 'photo')} with 16 bits"
    bits = white.bit_length()
    if white > WHITES[0] and top >= _REACHED * white:
        return white, [
            (
                f"{photos} contain {bits}-bit values (up to {top}), which are scaled: {white} "
                "is white"
            )
        ]
    return FULL_16_BIT, [
        (
            f"{photos} use {100 * top / FULL_16_BIT:.2g} % of their range (up to {top}) "
            f"and are dark; if they contain {bits}-bit values, save them scaled to 16 bits"
        )
    ]


@dataclass(frozen=True)
class ChosenPhotos:
    """The photos that were chosen for the views of a scene.

    Attributes:
        sources: Name of a view -> how its photo is decoded. Views without a photo are not included.
        pinholes: Name of a view -> pinhole calibration of the training photo.
        notes: Notes about photos that were left out, undistorted, resized or masked, and about
            unused files.
    """

    sources: Mapping[str, PhotoSource]
    pinholes: Mapping[str, Pinhole]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Found:
    """A photo folder, with the paths and headers of its photos by view name."""

    folder: PhotoFolder
    paths: Mapping[str, Path]
    headers: Mapping[str, PhotoHeader]

    @property
    def longest(self) -> int:
        """Longest side of all photos, in pixels."""
        return max(max(header.width, header.height) for header in self.headers.values())


def choose_photos(raw: RawScene, options: SceneOptions) -> ChosenPhotos:
    """Pair views with photos by name, and choose the training size of each photo.

    Raises:
        UserError: No view has a photo, a photo is damaged or does not match its camera, or the
            requested mask folder does not exist.
    """
    # If the photos are in the scene's root folder, neighbouring folders are outside the scene.
    folders = find_photo_folders(raw.images)[: 1 if raw.images == raw.root else None]
    names = sorted(view.name for view in raw.views)
    full = _read_full(folders[0], names)
    chosen, reduced_notes = _prefer_reduced(full, folders[1:], options.max_size)
    masks = _find_masks(raw, options, tuple(chosen.paths))
    white, white_notes = white_of([chosen.paths[n] for n, h in chosen.headers.items() if h.deep])
    sources: dict[str, PhotoSource] = {}
    pinholes: dict[str, Pinhole] = {}
    shared: dict[Calibration, Calibration] = {}
    for view in raw.views:
        if view.name not in chosen.paths:
            continue
        path, header = chosen.paths[view.name], chosen.headers[view.name]
        reduction = choose_reduction(path, header, options.max_size)
        header = header.reduced(reduction)
        width, height, orientation = _fit(view.calibration, header, path)
        fitted = view.calibration.resized(width, height)
        # Photos with equal calibrations share one undistortion.
        fitted = shared.setdefault(fitted, fitted)
        target = _limit(fitted.pinhole.width, fitted.pinhole.height, options.max_size)
        pinholes[view.name] = fitted.pinhole.resized(*target)
        sources[view.name] = PhotoSource(
            path=path,
            width=width,
            height=height,
            orientation=orientation,
            mask=masks.get(view.name),
            alpha=header.alpha,
            background=raw.background,
            distorted=None if fitted.is_pinhole else fitted,
            target=target,
            reduction=reduction,
            white=white if header.deep else FULL_16_BIT,
        )
    for name, mask in masks.items():
        source = sources[name]
        check_mask(mask, (source.width, source.height), may_turn=source.orientation != 1)
    used = [*full.paths.values(), *chosen.paths.values(), *masks.values()]
    started = [options.init_file] if options.init_file else []
    notes = (
        *note_pairing(full.folder, full.paths, names, used),
        *note_links(raw.root, sources),
        *reduced_notes,
        *note_undistortion(sources),
        *note_sizes(chosen.folder.path.name, sources, _calibrated_sizes(raw)),
        *note_reductions(sources),
        *white_notes,
        *note_kinds(sources, chosen.headers, raw.background),
        *note_memory(sources, options),
        *note_unused(raw, [*used, *started], find_mask_folder(options.masks, raw.root)),
    )
    return ChosenPhotos(sources, pinholes, notes)


def _calibrated_sizes(raw: RawScene) -> dict[str, tuple[int, int]]:
    return {view.name: (view.calibration.width, view.calibration.height) for view in raw.views}


def _read_full(folder: PhotoFolder, names: Sequence[str]) -> _Found:
    paths = _pair(folder, names)
    if not paths:
        raise UserError(
            "no photo was found for any image of the model",
            where=folder.path,
            expected=f"photos with the names of the model, such as {names[0]}",
            found=name_some(folder.names) or "no photo",
            todo="put the photos below the image folder, with the names that the model uses",
        )
    return _read_found(folder, paths)


def _read_found(folder: PhotoFolder, paths: Mapping[str, Path]) -> _Found:
    return _Found(folder, paths, {name: read_header(path) for name, path in paths.items()})


def _pair(folder: PhotoFolder, names: Sequence[str]) -> dict[str, Path]:
    return {name: folder.path / file for name, file in folder.pair(names).files.items()}


def _prefer_reduced(
    full: _Found, reduced: Sequence[PhotoFolder], max_size: int | None
) -> tuple[_Found, list[str]]:
    """Choose the largest photo folder within the size limit, or the full-size photos.

    If the photos of a reduced folder are smaller than half the limit, the full-size photos are
    used.
    """
    notes: list[str] = []
    if max_size is None or full.longest <= max_size:
        return full, notes
    for folder in reduced:
        paths = _pair(folder, tuple(full.paths))
        if len(paths) < len(full.paths):
            absent = [name for name in full.paths if name not in paths]
            notes.append(
                f"photos: {folder.path.name}/ is not used, because it lacks "
                f"{count(len(absent), 'photo')}: {name_some(absent)}"
            )
            continue
        candidate = _read_found(folder, paths)
        if candidate.longest <= max_size:
            return (candidate if 2 * candidate.longest >= max_size else full), notes
    return full, notes


def _fit(calibration: Calibration, header: PhotoHeader, path: Path) -> tuple[int, int, int]:
    """Return width, height and EXIF orientation of a photo in the orientation of its camera.

    COLMAP ignores the EXIF orientation. The stored orientation is therefore used, unless only the
    rotated photo has the aspect ratio of the camera.
    """
    width, height = header.width, header.height
    posed = calibration.width, calibration.height
    if is_scaled((width, height), posed):
        return width, height, 1
    orientation = read_quarter_turn(path)
    if orientation is not None and is_scaled((height, width), posed):
        return height, width, orientation
    raise UserError(
        "the aspect ratio of a photo differs from the aspect ratio of its camera",
        where=path,
        expected=f"{calibration.width} x {calibration.height} pixels, or the same aspect ratio",
        found=f"{width} x {height} pixels",
        todo="use the photos that the poses were estimated from",
    )


def _limit(width: int, height: int, max_size: int | None) -> tuple[int, int]:
    """Return a size whose longest side is within the limit. The aspect ratio does not change."""
    longest = max(width, height)
    if max_size is None or longest <= max_size:
        return width, height
    shortened = (int(side * max_size / longest + 0.5) for side in (width, height))
    new_width, new_height = (max(1, side) for side in shortened)
    return new_width, new_height


def _find_masks(raw: RawScene, options: SceneOptions, names: Sequence[str]) -> dict[str, Path]:
    folder = find_mask_folder(options.masks, raw.root)
    with_photo = frozenset(names)
    named = {view.name: view.mask for view in raw.views if view.mask and view.name in with_photo}
    if folder is None or (named and options.masks is None):
        return named
    masks = pair_masks(folder, names)
    check_masks(folder, options.masks, len(masks), names)
    return masks

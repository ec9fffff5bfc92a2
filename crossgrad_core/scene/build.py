"""Convert a reader's raw scene to a `Scene`: checks, photos, split, local frame and regimes."""

import logging
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from numpy.typing import NDArray

from crossgrad_core.contract.scene import Camera, Scene, View, footprint
from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.errors import UserError
from crossgrad_core.scene.frame import Frame, camera_centers, make_frame
from crossgrad_core.scene.photos.choose_photos import ChosenPhotos, choose_photos
from crossgrad_core.scene.photos.decode import decode_mask, decode_photo
from crossgrad_core.scene.photos.photo_files import with_photo_names
from crossgrad_core.scene.photos.photo_store import PhotoStore, store_folder
from crossgrad_core.scene.photos.photos import FilePhoto, PhotoCache, PhotoSource
from crossgrad_core.scene.point_cloud import FEWEST, PER_PHOTO, read_cloud, thinned
from crossgrad_core.scene.points_in_view import check_seen
from crossgrad_core.scene.raw import (
    CheckedPoints,
    RawScene,
    RawView,
    check_distances,
    check_points,
    check_views,
)
from crossgrad_core.scene.split import Label, Split, split_views
from crossgrad_core.scene.wording import count, name_some
from crossgrad_core.system.input_files import is_file
from crossgrad_core.wording import one_line

_LOG = logging.getLogger(__name__)
#: If at least this share of a photo's stored pixels is valid, undistortion and resizing cannot
#: remove all valid pixels. Below this share, the photo is decoded to check whether valid pixels
#: remain.
_SURE = 0.05
_HALF = 128


def without_blank_photos(split: Split, sources: Mapping[str, PhotoSource], root: Path) -> Split:
    """Return the split without training photos whose pixels are all masked.

    A note names the removed photos.

    The function reads masks and decodes photos with transparency. Held-out photos stay in the
    split. The metrics of a held-out photo that is masked completely report that no pixel is valid.

    Raises:
        UserError: No training photo has a valid pixel.
    """
    doubtful = [name for name in split.train if _can_be_blank(sources[name])]
    with ThreadPoolExecutor() as pool:
        are_blank = list(pool.map(_is_blank, [sources[name] for name in doubtful]))
    blank = [name for name, is_blank in zip(doubtful, are_blank, strict=True) if is_blank]
    if not blank:
        return split
    if len(blank) == len(split.train):
        raise _all_blank(blank, root)
    train = tuple(name for name in split.train if name not in set(blank))
    what = (
        f"{count(len(blank), 'training photo')} left out (all pixels are masked): "
        f"{name_some(blank)}"
    )
    return replace(split, train=train, notes=(*split.notes, f"masks: {what}"))


def _can_be_blank(source: PhotoSource) -> bool:
    return source.mask is not None or (source.alpha and source.background is None)


def _is_blank(source: PhotoSource) -> bool:
    if min(_counting_shares(source)) >= _SURE:
        return False
    keep = source.decode()[1]
    return keep is not None and not bool(keep.any())


def _counting_shares(source: PhotoSource) -> list[float]:
    """Return the shares of the stored pixels that the mask and the transparency mark as valid."""
    shares = [1.0]
    if source.mask is not None:
        shares.append(float((decode_mask(source.mask) > 0).mean()))
    if source.alpha and source.background is None:
        alpha = decode_photo(source.path)[1]
        shares.append(1.0 if alpha is None else float((alpha >= _HALF).mean()))
    return shares


def _all_blank(names: Sequence[str], root: Path) -> UserError:
    return UserError(
        "every pixel of every training photo is masked",
        where=root,
        expected="a pixel that is white in its mask, or opaque in a photo with transparency",
        found=f"no such pixel in {name_some(names)}",
        todo="invert the masks if black marks the pixels to use, or rename the mask "
        "folder to train without masks",
    )


def with_points_of_file(raw: RawScene, option: Path | None) -> RawScene:
    """Replace the points of a scene by the points of a file.

    The photos of the result have no observations of points.

    Args:
        raw: The scene from the reader.
        option: The point file, as a path or relative to the scene; None keeps the points of the
            reader.

    Raises:
        UserError: The file does not exist, cannot be read, contains Gaussians, or uses another
            coordinate frame than the cameras.
    """
    if option is None:
        return raw
    path = next(filter(is_file, (option, raw.root / option)), None)
    if path is None:
        raise UserError(
            "the point file does not exist",
            where=option,
            expected="a PLY, LAS or LAZ file, as a path or as a path below the scene folder",
            todo="check the path: --points FILE",
        )
    cloud = read_cloud(path, path.name)
    if cloud.gaussians:
        raise UserError(
            "the point file contains Gaussians instead of points",
            where=path,
            expected="a file with positions and colours",
            todo=f"use --init {option} to start from its Gaussians",
        )
    check_seen(
        cloud,
        raw.views,
        path,
        "crop the point cloud to the area that the photos show, or leave it out",
    )
    views = tuple(replace(view, seen=np.zeros(0, dtype=np.int64)) for view in raw.views)
    note = f"points: {len(cloud.positions):,} from {path.name}, instead of the scene's points"
    return replace(
        raw,
        views=views,
        points=cloud.positions,
        point_colors=cloud.colors,
        notes=(*raw.notes, note),
        files=(*raw.files, path),
    )


NEAR, FAR = "near", "far"
# Label of photos that are directly in the image folder while other photos are in subfolders.
_TOP = "images"
# Label of all views if near and far views cannot be distinguished.
_ONLY = "all"


def label_by_folder(names: Sequence[str]) -> tuple[str, ...] | None:
    """Label photos by the first folder in which their paths differ.

    Return None if all photos are in one folder.
    """
    folders = [PurePosixPath(name).parent.parts for name in names]
    shared = 0
    while len({parts[: shared + 1] for parts in folders}) == 1:
        if len(folders[0]) <= shared:
            return None
        shared += 1
    return tuple("/".join(parts[shared : shared + 1]) or _TOP for parts in folders)


def label_by_footprint(
    cameras: Sequence[Camera],
    seen: Sequence[NDArray[np.int64]],
    points: NDArray[np.float64],
    train: Sequence[int],
) -> tuple[str, ...]:
    """Label views as near or far by their footprints.

    The threshold is the median over the training views.

    A view is near if its footprint is at least the median. `contract.scene.footprint` defines the
    footprint. A view without a footprint uses the footprint of the nearest camera that has a
    footprint. If no view has a footprint, all views get the label `all`.

    Args:
        cameras: Cameras of all views, in the local frame.
        seen: For each view, the rows of `points` that the view observes.
        points: [P, 3] SfM points, in the local frame.
        train: Positions of the training views; the median is computed over these views.
    """
    footprints = np.array(
        [footprint(camera, points, rows) for camera, rows in zip(cameras, seen, strict=True)]
    )
    has_footprint = np.isfinite(footprints)
    trained = footprints[[i for i in train if has_footprint[i]]]
    if not len(trained):
        return (_ONLY,) * len(cameras)
    centers = np.stack([camera.center.numpy() for camera in cameras])
    for i in np.flatnonzero(~has_footprint):
        distance = np.linalg.norm(centers[has_footprint] - centers[i], axis=1)
        footprints[i] = footprints[has_footprint][distance.argmin()]
    threshold = np.median(trained)
    return tuple(NEAR if value >= threshold else FAR for value in footprints)


def build_scene(raw: RawScene, options: SceneOptions) -> Scene:
    """Build the scene for training from the raw scene of a reader.

    The scene does not include views without a photo, views that no split list contains, and
    training views that are masked completely. The local frame is computed from the training
    cameras. The function writes nothing to disk. A photo is decoded only if its mask or
    transparency may hide all of its pixels.

    Raises:
        UserError: The input cannot be used for training. The message names the cause, the file and
            the remedy.
    """
    raw = with_photo_names(raw)
    check_views(raw)
    raw = with_points_of_file(raw, options.points)
    points, point_notes = check_points(raw)
    if not any(len(view.seen) for view in raw.views):
        most = options.max_points or max(FEWEST, PER_PHOTO * len(raw.views))
        points, thin_notes = thinned(points, most)
        point_notes += thin_notes
    photos = choose_photos(raw, options)
    label = _labels(raw, photos, points)
    split = split_views(sorted(photos.sources), options, raw.root, raw.split, label)
    split = without_blank_photos(split, photos.sources, raw.root)
    listed = {*split.train, *split.test}
    used = sorted((v for v in raw.views if v.name in listed), key=lambda view: view.name)
    train = _positions(used, split.train)
    poses = np.stack([used[i].world_to_camera for i in train])
    frame = make_frame(camera_centers(poses), points.xyz)
    kept = replace(raw, views=tuple(used))
    points, far_notes = check_distances(kept, points, frame)
    doubtful = (*far_notes, *_note_stray([used[i].name for i in train], frame))
    for note in doubtful:
        _LOG.warning("%s", note)
    local = frame.points(points.xyz)
    cameras = [_localize(view, photos, frame) for view in used]
    seen = [points.rows(view.seen) for view in used]
    by_folder = label_by_folder([view.place or view.name for view in used])
    if split.regimes is not None:
        regimes = tuple(split.regimes[view.name] for view in used)
    else:
        regimes = by_folder or label_by_footprint(cameras, seen, local, train)
    store = PhotoStore(store_folder(), options.disk_mib)
    cache: PhotoCache[PhotoSource] = PhotoCache(options.cache_mib, store)
    return Scene(
        name=one_line(raw.root.resolve().name) or "scene",
        views=tuple(
            View(view.name, camera, FilePhoto(photos.sources[view.name], cache), regime, rows)
            for view, camera, regime, rows in zip(used, cameras, regimes, seen, strict=True)
        ),
        train=train,
        test=_positions(used, split.test),
        points=local,
        point_colors=points.colors,
        similarity=frame.similarity,
        files=raw.files,
        notes=(
            *raw.notes,
            *point_notes,
            *photos.notes,
            *split.notes,
            frame.note,
            *doubtful,
            _note_regimes(regimes, train, "image folder" if by_folder else "footprint"),
            *_note_unmeasured(regimes, train, options),
        ),
    )


def _labels(raw: RawScene, photos: ChosenPhotos, points: CheckedPoints) -> Label:
    """Return a function that labels views before the split is known.

    The function uses a local frame of all cameras.
    """
    views = sorted((v for v in raw.views if v.name in photos.sources), key=lambda view: view.name)
    names = [view.name for view in views]

    def label(train: Sequence[str]) -> Mapping[str, str]:
        if by_folder := label_by_folder([view.place or view.name for view in views]):
            return dict(zip(names, by_folder, strict=True))
        poses = np.stack([view.world_to_camera for view in views])
        frame = make_frame(camera_centers(poses), points.xyz)
        cameras = [_localize(view, photos, frame) for view in views]
        seen = [points.rows(view.seen) for view in views]
        local, rows = frame.points(points.xyz), _positions(views, train)
        labels = label_by_footprint(cameras, seen, local, rows)
        return dict(zip(names, labels, strict=True))

    return label


def _positions(views: Sequence[RawView], names: Sequence[str]) -> tuple[int, ...]:
    chosen = frozenset(names)
    return tuple(i for i, view in enumerate(views) if view.name in chosen)


def _localize(view: RawView, photos: ChosenPhotos, frame: Frame) -> Camera:
    pose = torch.from_numpy(frame.pose(view.world_to_camera))
    return Camera(**vars(photos.pinholes[view.name]), world_to_camera=pose)


def _note_stray(names: Sequence[str], frame: Frame) -> list[str]:
    stray = [name for name, is_stray in zip(names, frame.stray, strict=True) if is_stray]
    if not stray:
        return []
    return [
        (
            f"cameras: {count(len(stray), 'training camera')} far away from all other "
            f"cameras: {name_some(stray)}; the local frame is computed without them, and "
            "their poses may be wrong"
        )
    ]


def _note_regimes(regimes: Sequence[str], train: Sequence[int], how: str) -> str:
    views = Counter(regimes)
    trained = Counter(regimes[i] for i in train)
    parts = (
        f"{name} {views[name]} views ({trained[name]} train, {views[name] - trained[name]} test)"
        for name in sorted(views)
    )
    return f"regimes by {how}: {', '.join(parts)}"


def _note_unmeasured(
    regimes: Sequence[str], train: Sequence[int], options: SceneOptions
) -> Iterator[str]:
    """Yield a note about regimes without held-out photos, if another regime has held-out photos."""
    held_out = Counter(regimes) - Counter(regimes[i] for i in train)
    lacking = sorted(set(regimes) - set(held_out))
    if held_out and lacking:
        way = "--split stratified holds out photos of every regime"
        if options.split == "stratified":
            way = "this regime has too few photos"
        yield (
            f"split: no photo of {' and '.join(lacking)} is held out, so no metric shows "
            f"its quality; {way}"
        )

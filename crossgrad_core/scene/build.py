"""From what a reader found to a `Scene`: checks, photos, split, local frame, regimes."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch

from crossgrad_core.contract.scene import Camera, Scene, View
from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.scene.blank_photos import without_blank_photos
from crossgrad_core.scene.choose_photos import ChosenPhotos, choose_photos
from crossgrad_core.scene.frame import Frame, camera_centers, make_frame
from crossgrad_core.scene.photo_names import with_photo_names
from crossgrad_core.scene.photo_store import PhotoStore, store_folder
from crossgrad_core.scene.photos import FilePhoto, PhotoCache, PhotoSource
from crossgrad_core.scene.point_option import with_points_of_file
from crossgrad_core.scene.raw import RawScene, RawView
from crossgrad_core.scene.raw_checks import (
    CheckedPoints,
    check_distances,
    check_points,
    check_views,
)
from crossgrad_core.scene.regimes import label_by_folder, label_by_footprint
from crossgrad_core.scene.split import Label, split_views
from crossgrad_core.scene.thinning import FEWEST, PER_PHOTO, thinned
from crossgrad_core.scene.wording import count, name_some
from crossgrad_core.wording import one_line


def build_scene(raw: RawScene, options: SceneOptions) -> Scene:
    """The scene that is trained on.

    Views without a photo, or in neither split list, and training views that are masked as a whole
    are left out. The local frame is that of the training cameras. Nothing is written to disk, and
    no photo is decoded but those whose mask or transparency leaves it open whether a pixel counts.

    Raises:
        UserError: The input cannot be trained on; says what is wrong, where, and what to do.
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
            *far_notes,
            *photos.notes,
            *split.notes,
            frame.note,
            *_note_stray([used[i].name for i in train], frame),
            _note_regimes(regimes, train, "image folder" if by_folder else "footprint"),
            *_note_unmeasured(regimes, train, options),
        ),
    )


def _labels(raw: RawScene, photos: ChosenPhotos, points: CheckedPoints) -> Label:
    """Tells regimes before the split, when the local frame can only be that of all cameras."""
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
        f"cameras: {count(len(stray), 'training camera')} far away from all others: "
        f"{name_some(stray)}; the local frame is made without them, and their poses may be wrong"
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
    """Name the regimes without a held-out photo, where other regimes have one."""
    held_out = Counter(regimes) - Counter(regimes[i] for i in train)
    lacking = sorted(set(regimes) - set(held_out))
    if held_out and lacking:
        way = "--split stratified holds photos of every regime out"
        if options.split == "stratified":
            way = "there are too few photos of it"
        yield (
            f"split: no photo of {' and '.join(lacking)} is held out, so no figure tells how good "
            f"it gets; {way}"
        )

"""From what a reader found to a `Scene`: checks, photos, split, local frame, regimes."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import PurePosixPath

import numpy as np
import torch
from numpy.typing import NDArray

from crossgrad_core.errors import UserError
from crossgrad_core.scene.choose_photos import ChosenPhotos, choose_photos
from crossgrad_core.scene.frame import Frame, camera_centers, make_frame
from crossgrad_core.scene.options import SceneOptions
from crossgrad_core.scene.photos import FilePhoto, PhotoCache
from crossgrad_core.scene.raw import RawScene, RawView
from crossgrad_core.scene.regimes import label_by_folder, label_by_footprint
from crossgrad_core.scene.split import Split, split_views
from crossgrad_core.scene.types import Camera, Scene, View
from crossgrad_core.scene.wording import count, name_some

# Rotations written with six digits pass; a pose with a scale in it does not.
_RIGID = 1e-4


def build_scene(raw: RawScene, options: SceneOptions) -> Scene:
    """The scene that is trained on.

    Views without a photo, or in neither split list, are left out. The local frame is that of the
    training cameras; nothing is written to disk and no photo is decoded.

    Raises:
        UserError: The input cannot be trained on; says what is wrong, where, and what to do.
    """
    _check_views(raw)
    points, point_notes = _check_points(raw, options)
    photos = choose_photos(raw, options)
    split = split_views(sorted(photos.sources), options, raw.root, raw.split)
    used = [view for view in raw.views if view.name in {*split.train, *split.test}]
    used.sort(key=lambda view: view.name)
    train = _positions(used, split.train)
    poses = np.stack([view.world_to_camera for view in used])
    frame = make_frame(camera_centers(poses)[list(train)], points.xyz)
    local = frame.points(points.xyz)
    cameras = [_local_camera(view, photos, frame) for view in used]
    seen = [points.rows(view.seen) for view in used]
    folders = label_by_folder([view.name for view in used])
    regimes = folders or label_by_footprint(cameras, seen, local, train)
    cache = PhotoCache(options.cache_mib)
    views = tuple(
        View(view.name, camera, FilePhoto(photos.sources[view.name], cache), regime, rows)
        for view, camera, regime, rows in zip(used, cameras, regimes, seen, strict=True)
    )
    notes = (
        *raw.notes,
        *point_notes,
        *photos.notes,
        *split.notes,
        frame.note,
        _note_regimes(regimes, set(train), "image folder" if folders else "footprint"),
    )
    return Scene(
        name=raw.root.resolve().name or "scene",
        views=views,
        train=train,
        test=_positions(used, split.test),
        points=local,
        point_colors=points.colors,
        similarity=frame.similarity,
        notes=notes,
    )

"""Regimes: the labels under which results are reported."""

from collections.abc import Sequence
from pathlib import PurePosixPath

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.contract.poses import footprint
from crossgrad_core.contract.scene import Camera

NEAR, FAR = "near", "far"

# Label of the photos that lie directly in the image folder, beside folders.
_TOP = "images"
# Label of all views where nothing tells near from far.
_ONLY = "all"


def label_by_folder(names: Sequence[str]) -> tuple[str, ...] | None:
    """The first folder in which the names differ; None where all are in one folder."""
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
    """Near where the scene is drawn at least as large as in the median training view, else far.

    See `contract.poses.footprint`. A view without one takes that of the nearest camera that has
    one. Without a footprint at all, every view is in one regime `all`.

    Args:
        cameras: Cameras of all views, local frame.
        seen: Rows of `points` that each view observed.
        points: [P, 3], local frame.
        train: Indices of the training views: the median is theirs.
    """
    footprints = np.array(
        [footprint(camera, points, rows) for camera, rows in zip(cameras, seen, strict=True)]
    )
    known = np.isfinite(footprints)
    trained = footprints[[i for i in train if known[i]]]
    if not len(trained):
        return (_ONLY,) * len(cameras)
    centers = np.stack([camera.center.numpy() for camera in cameras])
    for i in np.flatnonzero(~known):
        distance = np.linalg.norm(centers[known] - centers[i], axis=1)
        footprints[i] = footprints[known][distance.argmin()]
    threshold = np.median(trained)
    return tuple(NEAR if value >= threshold else FAR for value in footprints)

"""Regimes: the labels under which results are reported."""

from collections.abc import Sequence
from pathlib import PurePosixPath

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.contract.scene import Camera

NEAR, FAR = "near", "far"

# Label of the photos that lie directly in the image folder, beside folders.
_TOP = "images"
# Label of all views where nothing tells near from far.
_ONLY = "all"
# A median over fewer observed points says little; points in the frustum are taken instead.
_MIN_SEEN = 3
# Points tested against the frustum of a view that observed none.
_MAX_TESTED = 50_000


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
    """Near where a pixel covers no more of the scene than in the median training view, else far.

    The footprint of a view is the median of z / f over the SfM points that it observed, in the
    pixels that are trained on; over the points in its frustum where it observed fewer than 3. A
    view without any takes the label of the nearest camera that has one. Without a footprint at all,
    every view is in one regime `all`.

    Args:
        cameras: Cameras of all views, local frame.
        seen: Rows of `points` that each view observed.
        points: [P, 3], local frame.
        train: Indices of the training views: the median is theirs.
    """
    footprint = np.array(
        [_footprint(camera, rows, points) for camera, rows in zip(cameras, seen, strict=True)]
    )
    known = np.isfinite(footprint)
    trained = footprint[[i for i in train if known[i]]]
    if not len(trained):
        return (_ONLY,) * len(cameras)
    centers = np.stack([camera.center.numpy() for camera in cameras])
    for i in np.flatnonzero(~known):
        distance = np.linalg.norm(centers[known] - centers[i], axis=1)
        footprint[i] = footprint[known][distance.argmin()]
    threshold = np.median(trained)
    return tuple(NEAR if value <= threshold else FAR for value in footprint)


def _footprint(camera: Camera, rows: NDArray[np.int64], points: NDArray[np.float64]) -> float:
    """Median of z / f in local units per pixel; NaN where the view has no point."""
    depth = _depth(camera, points[rows])
    depth = depth[depth > 0]
    if len(depth) < _MIN_SEEN:
        inside = _depth_in_frustum(camera, points[:: max(1, len(points) // _MAX_TESTED)])
        depth = inside if len(inside) else depth
    focal = (camera.fx * camera.fy) ** 0.5
    return float(np.median(depth)) / focal if len(depth) else float("nan")


def _depth(camera: Camera, points: NDArray[np.float64]) -> NDArray[np.float64]:
    pose = camera.world_to_camera.numpy()
    return np.asarray(points @ pose[2, :3] + pose[2, 3])


def _depth_in_frustum(camera: Camera, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """[M] depths of the points that project into the photo."""
    pose = camera.world_to_camera.numpy()
    local = points @ pose[:3, :3].T + pose[:3, 3]
    x, y, z = local[local[:, 2] > 0].T
    u = camera.fx * x / z + camera.cx
    v = camera.fy * y / z + camera.cy
    return np.asarray(z[(u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)])

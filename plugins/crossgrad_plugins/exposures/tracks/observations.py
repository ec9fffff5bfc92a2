"""All observations of SfM points in some photos, with their brightness."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import Scene, UserError, View
from crossgrad_plugins.exposures.tracks.light import light_at

#: Observations that are looked at; of more, every so many points are left out.
_MOST = 400_000
#: Photos that are decoded at once; more of them would take memory.
_AT_ONCE = 2


@dataclass(frozen=True, eq=False)
class Observations:
    """Usable observations of points that at least two of the photos show.

    Attributes:
        photos: [O] position of the photo among those that were looked at.
        points: [O] numbers of the points, from 0 on without gaps.
        stops: [O] log2 of the brightness in linear light.
        rows: [N] the row of each number among the points of the scene.
    """

    photos: NDArray[np.int64]
    points: NDArray[np.int64]
    stops: NDArray[np.float64]
    rows: NDArray[np.int64]

    @property
    def count(self) -> int:
        """How many there are."""
        return len(self.stops)


def observations_of(scene: Scene, views: Sequence[View]) -> Observations:
    """The observations of the scene's points in the photos of some views.

    A photo is looked at where its pose puts the points that it observed, 3 x 3 pixels for each.
    Photos without such points are not decoded. A photo that cannot be decoded has no observations:
    the run reports it when it needs the photo.
    """
    shared = _shared_points(scene, views)
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        found = list(pool.map(lambda view: _observed(scene, view, shared), views))
    photos = np.repeat(np.arange(len(views)), [len(rows) for rows, _ in found])
    rows = np.concatenate([np.zeros(0, dtype=np.int64), *(rows for rows, _ in found)])
    stops = np.concatenate([np.zeros(0), *(stops for _, stops in found)])
    # What is too dark or cut off in all photos but one tells nothing about that one.
    _, numbers, times = np.unique(rows, return_inverse=True, return_counts=True)
    kept = times[numbers] > 1
    known, numbers = np.unique(rows[kept], return_inverse=True)
    return Observations(photos[kept], numbers, stops[kept], known)


def _shared_points(scene: Scene, views: Sequence[View]) -> NDArray[np.bool_]:
    """[P] which points are looked at: those that two views observed, and of many a part."""
    times = np.zeros(len(scene.points), dtype=np.int64)
    for view in views:
        times[view.seen] += 1
    shared = times > 1
    every = -(-int(times[shared].sum()) // _MOST)
    if every > 1:
        left = np.flatnonzero(shared)
        shared[np.delete(left, np.s_[::every])] = False
    return shared


def _observed(
    scene: Scene, view: View, shared: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Rows of the points that a photo shows in usable brightness, and its stops."""
    seen = view.seen[shared[view.seen]]
    if not len(seen):
        return seen, np.zeros(0)
    photo = view.photo
    try:
        image, mask = photo.image(), photo.mask()
    except UserError:
        return seen[:0], np.zeros(0)
    found = light_at(image, mask, view.camera, scene.points[seen])
    rows = found.rows[found.usable]
    return seen[rows], np.log2(found.brightness[found.usable])

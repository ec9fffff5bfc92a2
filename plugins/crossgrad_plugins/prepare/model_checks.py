"""Models that global mapping holds together by nothing: taken apart by the points they share."""

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

if TYPE_CHECKING:
    import pycolmap

#: Points that a pose needs, as in COLMAP's incremental mapping, and that two photos of one model
#: share, directly or by others in between: as many as the matches of a verified pair.
_POINTS, _SHARED = 30, 15


def sound_models(
    models: "Iterable[pycolmap.Reconstruction]", smallest: int
) -> "list[pycolmap.Reconstruction]":
    """The models without photos that too few points hold, each part of a model by itself.

    Global mapping places every photo that rotations reach, by a single wrong pair if need be, and
    says nothing of it; the points that survive tell.

    Args:
        models: The models as mapping left them.
        smallest: Photos that a model has at least.
    """
    return [
        _only(model, part) for model in models for part in _parts(model) if len(part) >= smallest
    ]


def _parts(model: "pycolmap.Reconstruction") -> list[frozenset[int]]:
    """Numbers of the photos of each part."""
    numbers = np.array(sorted(model.reg_image_ids()))
    counts = np.array([model.image(int(number)).num_points3D for number in numbers])
    held = numbers[counts >= _POINTS]
    if not len(held):
        return []
    tracks = [
        {element.image_id for element in point.track.elements} for point in model.points3D.values()
    ]
    rows = np.concatenate([np.array(sorted(track), dtype=np.int64) for track in tracks])
    columns = np.repeat(np.arange(len(tracks)), [len(track) for track in tracks])
    kept = np.isin(rows, held)
    places = np.searchsorted(held, rows[kept])
    shape = (len(held), len(tracks))
    seen = coo_matrix((np.ones(len(places)), (places, columns[kept])), shape=shape).tocsr()
    _, labels = connected_components((seen @ seen.T) >= _SHARED, directed=False)
    return [frozenset(held[labels == label].tolist()) for label in np.unique(labels)]


def _only(model: "pycolmap.Reconstruction", part: frozenset[int]) -> "pycolmap.Reconstruction":
    """The model with the photos of a part alone."""
    import pycolmap

    alone = pycolmap.Reconstruction(model)
    for number in list(alone.reg_image_ids()):
        if number not in part:
            alone.deregister_frame(alone.image(number).frame_id)
    return alone

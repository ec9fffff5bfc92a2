"""Where cameras are: distances from the middle, and how large the scene appears to them."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.contract.scene import Camera, Scene, View, centers_of

#: A median over fewer observed points says little; points in the image are taken instead.
_FEWEST_SEEN = 3
#: Points tested against the image of a view that observed too few.
_MOST_TESTED = 50_000
#: Of a length between cameras; what is behind them is rounding.
_BITS = 40
#: Of a coordinate of the input, what its rounding and that of some sums with it may make.
_ROUNDED = 16 * float(np.finfo(np.float64).eps)


def radial_distances(scene: Scene, views: Sequence[View]) -> NDArray[np.float64]:
    """[V] distance of each camera from the mean training camera centre, local units.

    Without what is rounding: a camera that stands there has 0, and equal distances are equal.
    """
    return without_rounding(scene, np.linalg.norm(centers_of(views) - scene.middle, axis=1))


def without_rounding(scene: Scene, lengths: NDArray[np.float64]) -> NDArray[np.float64]:
    """Lengths [V] between camera centres, rounded to 2^-40 (1e-12) of the largest coordinate.

    What the mean of the training cameras is taken from differs by its rounding alone in layouts
    that are regular, and a cut at the median, a rank or a logarithm would depend on it. Where the
    scene's input has coordinates that are so large that they are rounded more, that decides.
    """
    largest = float(np.abs(scene.centers).max(initial=0.0))
    given = float(np.abs(scene.similarity.to_input(scene.centers)).max(initial=0.0))
    least = max(largest * 2.0**-_BITS, given * scene.similarity.scale * _ROUNDED)
    if not 0.0 < least < np.inf:
        return lengths
    step = 2.0 ** np.ceil(np.log2(least))
    return np.asarray(np.round(lengths / step) * step)


def footprint_of(scene: Scene, view: View) -> float:
    """`footprint` of a view of the scene."""
    return footprint(view.camera, scene.points, view.seen)


def footprint(camera: Camera, points: NDArray[np.float64], seen: NDArray[np.int64]) -> float:
    """Median of f / z [pixels per local unit] over the SfM points that a camera observed.

    Over those in its image where it observed fewer than 3 in front of it; NaN where there is none.

    Args:
        camera: The camera, in the size of the photo as trained.
        points: [P, 3] SfM points, local frame.
        seen: Rows of `points` that it observed.
    """
    depths = _in_front(camera, points[seen])[:, 2]
    if len(depths) < _FEWEST_SEEN:
        tested = points[:: max(1, len(points) // _MOST_TESTED)]
        inside = camera.local(tested[is_in_image(camera, tested)])[:, 2]
        depths = inside if len(inside) else depths
    if not len(depths):
        return float("nan")
    return float(np.sqrt(camera.fx * camera.fy) / np.median(depths))


def _in_front(camera: Camera, points: NDArray[np.float64]) -> NDArray[np.float64]:
    local = camera.local(points)
    return local[local[:, 2] > 0.0]


def is_in_image(camera: Camera, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """[P] whether a camera has points [P, 3] of the local frame in its image, seen or hidden."""
    local = camera.local(points)
    front = local[:, 2] > 0.0
    depth = np.where(front, local[:, 2], 1.0)
    x, y = camera.fx * local[:, 0] / depth + camera.cx, camera.fy * local[:, 1] / depth + camera.cy
    return np.asarray(front & (x >= 0.0) & (x < camera.width) & (y >= 0.0) & (y < camera.height))

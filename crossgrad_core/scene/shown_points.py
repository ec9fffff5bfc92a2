"""Count the training photos that show a typical point of a scene."""

from typing import Final

import numpy as np

from crossgrad_core.contract.scene import Scene, is_in_image

#: Number of points in the sample.
_POINTS: Final = 1000


def photos_per_point(scene: Scene) -> float:
    """Return the median number of training photos that show an SfM point.

    Return 0 without points.
    """
    points = scene.points[:: -(-len(scene.points) // _POINTS) or 1]
    counts = np.zeros(len(points), np.int64)
    for view in scene.train_views:
        counts += is_in_image(view.camera, points)
    shown = counts[counts > 0]
    return float(np.median(shown)) if len(shown) else 0.0

"""How many training photos show the points of a scene."""

from typing import Final

import numpy as np

from crossgrad_core.contract.scene import Scene, is_in_image

#: Points that are looked at, spread over all.
_POINTS: Final = 1000


def photos_per_point(scene: Scene) -> float:
    """In how many training photos an SfM point lies, seen or hidden: the median; 0 without any."""
    points = scene.points[:: -(-len(scene.points) // _POINTS) or 1]
    counts = np.zeros(len(points), np.int64)
    for view in scene.train_views:
        counts += is_in_image(view.camera, points)
    shown = counts[counts > 0]
    return float(np.median(shown)) if len(shown) else 0.0

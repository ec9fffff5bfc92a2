"""Single cameras far away from all others, which must not decide how large a scene is."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

#: Cameras without which none can be told to be stray.
_FEWEST: Final = 5
#: Largest share of the cameras that is stray; one may be in any case.
_MOST: Final = 0.1
#: A stray camera is so many times farther from the middle than the others, and than the points.
_FAR: Final = 10.0
#: Share of the points that the points' distance is taken of: single ones lie astray, too.
_OF_POINTS: Final = 0.9


def stray_rows(centers: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """[N] which cameras are stray: ten times farther away than all others and than most points.

    A camera that photographs the scene from afar is none, because the points show the scene's size.

    Args:
        centers: [N, 3] camera centres.
        points: [P, 3] SfM points in the same frame; may be empty.
    """
    none = np.zeros(len(centers), dtype=np.bool_)
    if len(centers) < _FEWEST:
        return none
    middle = np.median(centers, axis=0)
    away = np.linalg.norm(centers - middle, axis=1)
    most = max(1, int(_MOST * len(centers)))
    order = np.argsort(away)
    # The widest gap among the farthest cameras separates those that are stray.
    ratios = away[order][-most:] / np.maximum(away[order][-most - 1 : -1], np.finfo(float).tiny)
    first = len(centers) - most + int(ratios.argmax())
    reach = away[order[first - 1]]
    if ratios.max() <= _FAR or reach == 0.0:
        return none
    if len(points):
        ways = np.linalg.norm(points - middle, axis=1)
        reach = max(reach, float(np.quantile(ways, _OF_POINTS)))
    none[order[first:]] = away[order[first:]] > _FAR * reach
    return none

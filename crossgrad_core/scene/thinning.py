"""Dense point clouds are thinned to the density of SfM points before anything starts from them."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.scene.raw_checks import CheckedPoints

#: Points that are kept by default: this many, or more if there are many photos. Structure from
#: motion finds a few hundred points per photo.
FEWEST: Final = 100_000
PER_PHOTO: Final = 1_000
#: Cubes of this many sizes are tried, until at least this share of the wanted points is left.
_TRIES, _ENOUGH = 12, 0.8
#: Points that are looked at to find how large a cloud is.
_SAMPLED: Final = 100_000
#: Points on surfaces: their number falls with the square of the side.
_SURFACE: Final = 2.0
#: Rows and layers of cubes, as odd factors of a hash.
_FACTORS = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], dtype=np.uint64)
_FARTHEST: Final = 2.0**62
#: Side of the cubes where all points are in one place, in input units.
_SMALLEST: Final = 1e-12


def thinned(points: CheckedPoints, most: int) -> tuple[CheckedPoints, list[str]]:
    """At most `most` of the points, one from each cube of a grid, and a note.

    The first point of the file in each cube is kept, so that equal input gives equal points.
    """
    count = len(points.xyz)
    if count <= most:
        return points, []
    rows, side = _one_per_cube(points.xyz, most)
    chosen = np.zeros(count, dtype=np.bool_)
    chosen[rows] = True
    how = f"from each cube with a side of {side:.3g} input units" if side else "of so many"
    kept = f"{len(rows):,} of {count:,} kept, one {how}"
    return points.selected(chosen), [f"points: {kept} (--set data.max_points=N keeps more)"]


def _one_per_cube(xyz: NDArray[np.float64], most: int) -> tuple[NDArray[np.int64], float]:
    """Rows of the first point in each cube, at most `most`, and the side of the cubes.

    Where no cubes are that few, the points are evenly spread over the file, and the side is 0.
    """
    sample = xyz[:: -(-len(xyz) // _SAMPLED)]
    low, high = np.percentile(sample, [1.0, 99.0], axis=0)
    span = float((high - low).max())
    side = max(span, _SMALLEST) / most ** (1.0 / _SURFACE)
    best = np.arange(0, len(xyz), -(-len(xyz) // most))
    best_side, few, many = 0.0, np.inf, 0.0
    for _ in range(_TRIES):
        rows = _first_in_cubes((xyz - low) / side)
        if len(rows) <= most:
            few = side
            if best_side == 0.0 or len(rows) > len(best):
                best, best_side = rows, side
            if len(rows) >= _ENOUGH * most:
                break
        else:
            many = side
        guess = side * (len(rows) / (0.9 * most)) ** (1.0 / _SURFACE)
        side = guess if many < guess < few else float(np.sqrt(many * few))
    return best, best_side


def _first_in_cubes(places: NDArray[np.float64]) -> NDArray[np.int64]:
    """Rising rows of the first of the points [P, 3] in each unit cube."""
    cubes = np.floor(places.clip(-_FARTHEST, _FARTHEST)).astype(np.int64).astype(np.uint64)
    keys = (cubes * _FACTORS).sum(axis=1, dtype=np.uint64)
    return np.sort(np.unique(keys, return_index=True)[1])

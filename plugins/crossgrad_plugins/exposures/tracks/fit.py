"""The brightness of photos and points from observations: a robust fit of two-way effects.

Model: stops of photo i at point j = gain_i + point_j, Huber's loss, mean gain 0. Iteratively
reweighted least squares; the points are eliminated, and conjugate gradients solve for the gains.
Where photos hang together in several parts that share no point, each part has a mean of 0.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crossgrad_plugins.exposures.tracks.observations import Observations

#: Huber's constant, in standard deviations: 95 % efficient where errors are normal.
_HUBER = 1.345
#: Standard deviations of a normal law in one median absolute deviation.
_NORMAL = 1.4826
_ROUNDS = 12
#: Residuals below it, in stops, are rounding of 8-bit values.
_SMALLEST = 1e-3
#: What the gains may be off by, in stops; rounding allows less.
_TOLERANCE = 1e-5

_Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Fit:
    """How bright photos are beside each other.

    Attributes:
        gains: [V] stops of each photo above their mean; 0 where it has no observation.
        before: Standard deviation of the observations around the means of their points, stops.
        after: The same once the gains are taken out.
    """

    gains: _Floats
    before: float
    after: float

    @property
    def reduction(self) -> float:
        """Which share of the deviation the gains take away."""
        return 1.0 - self.after / self.before if self.before > 0.0 else 0.0


def fitted(observations: Observations, photos: int) -> Fit:
    """The gains of `photos` photos."""
    o = observations
    gains = np.zeros(photos)
    if not o.count:
        return Fit(gains, 0.0, 0.0)
    before = o.stops - _means(o.points, o.stops, np.ones(o.count))[o.points]
    residuals = before
    for _ in range(_ROUNDS):
        scale = max(_NORMAL * float(np.median(np.abs(residuals))), _SMALLEST)
        weights = np.minimum(1.0, _HUBER * scale / np.maximum(np.abs(residuals), _SMALLEST))
        gains = _solved(o, weights, gains)
        rest = o.stops - gains[o.photos]
        residuals = rest - _means(o.points, rest, weights)[o.points]
    return Fit(_centred(o, gains), float(before.std()), float(residuals.std()))


def _centred(o: Observations, gains: _Floats) -> _Floats:
    """The gains with a mean of 0 over the photos of each part that hangs together."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = len(gains)
    size = count + int(o.points.max()) + 1
    # Graphs of older scipy have indices of 32 bits alone.
    ends = o.photos.astype(np.int32), (count + o.points).astype(np.int32)
    edges = coo_array((np.ones(o.count), ends), shape=(size, size))
    parts = connected_components(edges, directed=False)[1][:count]
    means = np.bincount(parts, gains) / np.maximum(np.bincount(parts), 1)
    return np.asarray(gains - means[parts])


def _means(points: NDArray[np.int64], values: _Floats, weights: _Floats) -> _Floats:
    """[N] weighted mean of the values of each point."""
    return np.asarray(np.bincount(points, values * weights) / np.bincount(points, weights))


def _solved(o: Observations, weights: _Floats, start: _Floats) -> _Floats:
    """The gains that minimise the weighted squares, by conjugate gradients (Jacobi)."""
    count = len(start)
    diagonal = np.bincount(o.photos, weights, count)
    scale = 1.0 / np.maximum(diagonal, _SMALLEST)

    def deviations(values: _Floats) -> _Floats:
        """Sum over each photo of what its observations are above the means of their points."""
        above = values - _means(o.points, values, weights)[o.points]
        return np.asarray(np.bincount(o.photos, weights * above, count))

    gains = start.copy()
    gradient = deviations(o.stops - gains[o.photos])
    enough = _TOLERANCE**2 * float(diagonal.sum())
    direction = scale * gradient
    length = float(gradient @ direction)
    for _ in range(2 * count):
        if length <= enough:
            break
        step = deviations(direction[o.photos])
        along = float(direction @ step)
        gains += length / along * direction
        gradient = gradient - length / along * step
        scaled = scale * gradient
        length, former = float(gradient @ scaled), length
        direction = scaled + length / former * direction
    return gains

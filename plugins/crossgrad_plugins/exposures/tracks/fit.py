"""The brightness of photos and points from observations: a robust fit of two-way effects.

Model: stops of photo i at point j = gain_i + point_j, Huber's loss, mean gain 0. Iteratively
reweighted least squares; the points are eliminated. In what is left each photo stands beside those
with common points. Where these are few, as along a strip of hundreds of photos, the gains are found
directly: iterations would go on for long. Where they are many, iterations (conjugate gradients) are
few, and the direct way is the long one. Where photos hang together in several parts that share no
point, each part has a mean of 0.
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
#: Photos that share points with each one, in the mean, up to which the direct way is the quick one,
#: and photos in all up to which iterations cross any strip.
_FEW, _SHORT = 64, 64
#: What gains may be off by after iterations, in stops; rounding allows less.
_TOLERANCE = 1e-5
#: Residuals below it, in stops, are rounding of 8-bit values.
_SMALLEST = 1e-3

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
    if not o.count:
        return Fit(np.zeros(photos), 0.0, 0.0)
    gains, parts = np.zeros(photos), _parts(o, photos)
    few = photos > _SHORT and _neighbours(o, photos) <= _FEW
    before = o.stops - _means(o.points, o.stops, np.ones(o.count))[o.points]
    residuals = before
    for _ in range(_ROUNDS):
        scale = max(_NORMAL * float(np.median(np.abs(residuals))), _SMALLEST)
        weights = np.minimum(1.0, _HUBER * scale / np.maximum(np.abs(residuals), _SMALLEST))
        gains = _direct(o, weights, parts) if few else _iterated(o, weights, gains)
        rest = o.stops - gains[o.photos]
        residuals = rest - _means(o.points, rest, weights)[o.points]
    means = np.bincount(parts, gains) / np.maximum(np.bincount(parts), 1)
    return Fit(gains - means[parts], float(before.std()), float(residuals.std()))


def _parts(o: Observations, photos: int) -> NDArray[np.int64]:
    """[V] the part that each photo belongs to: those of one part hang together by points."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    size = photos + int(o.points.max()) + 1
    # Graphs of older scipy have indices of 32 bits alone.
    ends = o.photos.astype(np.int32), (photos + o.points).astype(np.int32)
    edges = coo_array((np.ones(o.count), ends), shape=(size, size))
    return np.asarray(connected_components(edges, directed=False)[1][:photos], dtype=np.int64)


def _means(points: NDArray[np.int64], values: _Floats, weights: _Floats) -> _Floats:
    """[N] weighted mean of the values of each point."""
    return np.asarray(np.bincount(points, values * weights) / np.bincount(points, weights))


def _neighbours(o: Observations, photos: int) -> float:
    """How many photos share points with each one, itself included, in the mean."""
    from scipy.sparse import coo_array

    shape = photos, int(o.points.max()) + 1
    seen = coo_array((np.ones(o.count, np.int32), (o.photos, o.points)), shape=shape).tocsr()
    return float((seen @ seen.T).nnz) / photos


def _direct(o: Observations, weights: _Floats, parts: NDArray[np.int64]) -> _Floats:
    """The gains that minimise the weighted squares; 0 of the first photo of each part."""
    from scipy.sparse import coo_array
    from scipy.sparse.linalg import spsolve

    gains, count = np.zeros(len(parts)), len(parts)
    free = np.ones(count, dtype=np.bool_)
    free[np.unique(parts, return_index=True)[1]] = False
    if not free.any():
        return gains
    of_points = np.bincount(o.points, weights)
    weight = coo_array((weights, (o.photos, o.points)), shape=(count, len(of_points))).tocsr()
    every = np.arange(count)
    own = coo_array((np.bincount(o.photos, weights, count), (every, every)))
    coupled = (own.tocsr() - (weight * (1.0 / of_points)) @ weight.T).tocsc()
    above = o.stops - _means(o.points, o.stops, weights)[o.points]
    wanted = np.bincount(o.photos, weights * above, count)
    gains[free] = spsolve(coupled[free][:, free], wanted[free], permc_spec="MMD_AT_PLUS_A")
    return gains


def _iterated(o: Observations, weights: _Floats, start: _Floats) -> _Floats:
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

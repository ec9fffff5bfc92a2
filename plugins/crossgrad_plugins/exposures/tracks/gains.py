"""Relative brightness of the photos of a scene, by a robust fit to SfM tracks.

Model: stops of photo i at point j = gain_i + point_j, Huber's loss, mean gain 0. Iteratively
reweighted least squares; the points are eliminated. In what is left each photo stands beside those
with common points. Where these are few, as along a strip of hundreds of photos, the gains are found
directly: iterations would go on for long. Where they are many, iterations (conjugate gradients) are
few, and the direct way is the long one. Where photos hang together in several parts that share no
point, each part has a mean of 0.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import Scene, View
from crossgrad_plugins.exposures.tracks.observations import Observations, observations_of

if TYPE_CHECKING:
    from scipy.sparse import csc_array


#: Usable observations without which tracks tell nothing about a photo.
LEAST = 8
#: Rule by which tracks say that photos differ in exposure: standard deviation of the gains in
#: stops, that deviation over its own standard error, and share of the distance of observations from
#: their points that the gains take away. Measured on scenes with and without (docs/exposure.md).
LEAST_SPREAD, LEAST_RATIO, LEAST_REDUCTION = 0.2, 4.0, 0.15
#: Photos from which on no single one decides: all points of one may lie on what others hide.
_ENOUGH = 5
#: Photos that decide. Of more, runs of consecutive ones do, because these show the same points.
MOST_DECIDING, _CONSECUTIVE = 128, 8
# A run asks more than once, and a scene does not change.
_OF_TRAINING: "WeakKeyDictionary[Scene, TrackGains]" = WeakKeyDictionary()
_DECIDING: "WeakKeyDictionary[Scene, TrackGains]" = WeakKeyDictionary()
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
#: Photos up to which standard errors are worked out: their matrix is dense.
_DENSE = 512
#: Eigenvalues below this share of the largest one belong to the level of a part, which is free.
_RANK = 1e-9
#: Residuals below it, in stops, are rounding of 8-bit values.
_SMALLEST = 1e-3
_Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Fit:
    """How bright photos are beside each other.

    Attributes:
        gains: [V] stops of each photo above their mean; 0 where it has no observation.
        before: Mean distance of the observations from the means of their points, stops. A point
            counts by the variance of the gains of the photos that show it, because only points
            that join photos of different gains test these.
        after: The same once the gains are taken out.
        errors: [V] standard errors of the gains, stops; NaN for more photos than `_DENSE`.
    """

    gains: _Floats
    before: float
    after: float
    errors: _Floats

    @property
    def reduction(self) -> float:
        """Which share of the deviation the gains take away."""
        return 1.0 - self.after / self.before if self.before > 0.0 else 0.0


@dataclass(frozen=True, eq=False)
class TrackGains:
    """How bright photos are beside each other where they show the same points.

    Attributes:
        gains: [V] stops above the mean of the photos; 0 where tracks tell nothing.
        counts: [V] usable observations.
        fit: How well the gains explain the observations.
    """

    gains: NDArray[np.float64]
    counts: NDArray[np.int64]
    fit: Fit

    @property
    def known(self) -> NDArray[np.bool_]:
        """[V] about which photos tracks tell something."""
        return self.counts >= LEAST

    @property
    def spread(self) -> float:
        """Standard deviation of the gains, stops."""
        return float(self.gains[self.known].std()) if self.known.any() else 0.0

    @property
    def error(self) -> float:
        """Standard error of the gains, stops, root mean square over the photos."""
        errors = self.fit.errors[self.known]
        return float(np.sqrt(np.square(errors).mean())) if len(errors) else 0.0

    @property
    def differ(self) -> bool:
        """Whether the photos differ in exposure, by the rule."""
        sure = self.spread >= LEAST_RATIO * self.error
        return sure and self._lasting >= LEAST_SPREAD and self.fit.reduction >= LEAST_REDUCTION

    @property
    def _lasting(self) -> float:
        """The spread without the photo farthest from the mean, if there are photos enough."""
        known = self.gains[self.known]
        if len(known) < _ENOUGH:
            return self.spread
        return float(np.delete(known, np.argmax(np.abs(known - known.mean()))).std())

    @property
    def evidence(self) -> str:
        """What the rule goes by, in words."""
        known = self.gains[self.known]
        if not len(known):
            return "no SfM tracks tell how bright the photos are beside each other"
        error = f", standard error {self.error:.2f}" if isfinite(self.error) else ""
        return (
            f"brightness of {len(known)} photos at {int(self.counts.sum()):,} observations of SfM "
            f"points: gains of {self.spread:.2f} stops standard deviation ({known.min():+.2f} to "
            f"{known.max():+.2f}{error}); where points join photos "
            f"of different gains, they take {100.0 * self.fit.reduction:.0f} % off the deviation "
            f"({self.fit.before:.2f} to {self.fit.after:.2f} stops)"
        )


def track_gains(scene: Scene, views: Sequence[View]) -> TrackGains:
    """The gains of the photos of some views."""
    observations = observations_of(scene, views)
    fit = fitted(observations, len(views))
    counts = np.bincount(observations.photos, minlength=len(views))
    known = counts >= LEAST
    gains = np.where(known, fit.gains - fit.gains[known].mean() if known.any() else 0.0, 0.0)
    return TrackGains(gains, counts, fit)


def training_gains(scene: Scene) -> TrackGains:
    """The gains of all training photos, worked out once for a scene."""
    found = _OF_TRAINING.get(scene)
    if found is None:
        found = _OF_TRAINING[scene] = track_gains(scene, scene.train_views)
    return found


def deciding_gains(scene: Scene) -> TrackGains:
    """The gains that decide whether the training photos differ, worked out once for a scene."""
    views = scene.train_views
    if len(views) <= MOST_DECIDING:
        return training_gains(scene)
    found = _DECIDING.get(scene)
    if found is None:
        period = _CONSECUTIVE * len(views) // MOST_DECIDING
        chosen = [view for row, view in enumerate(views) if row % period < _CONSECUTIVE]
        found = _DECIDING[scene] = track_gains(scene, chosen[:MOST_DECIDING])
    return found


def fitted(observations: Observations, photos: int) -> Fit:
    """The gains of `photos` photos."""
    o = observations
    if not o.count:
        return Fit(np.zeros(photos), 0.0, 0.0, np.zeros(photos))
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
    variances = _variances(o, gains)
    return Fit(
        gains=gains - means[parts],
        before=float(np.average(np.abs(before), weights=variances)),
        after=float(np.average(np.abs(residuals), weights=variances)),
        errors=_errors(o, weights, residuals, parts),
    )


def _variances(o: Observations, gains: _Floats) -> _Floats:
    """[N] variance of the gains of the photos that show the point of each observation.

    All are 1 if no point joins photos of different gains.
    """
    even = np.ones(o.count)
    above = gains[o.photos] - _means(o.points, gains[o.photos], even)[o.points]
    variances = _means(o.points, above**2, even)[o.points]
    return variances if variances.any() else even


def _errors(
    o: Observations, weights: _Floats, residuals: _Floats, parts: NDArray[np.int64]
) -> _Floats:
    """[V] standard errors of the gains by weighted least squares.

    Groups of photos that few points join have large ones, however many observations there are.
    """
    photos = len(parts)
    if photos > _DENSE:
        return np.full(photos, np.nan)
    free = o.count - int(o.points.max()) - 1 - photos + len(np.unique(parts))
    variance = float(residuals @ residuals) / max(free, 1)
    normal = _normal_matrix(o, weights, photos).toarray()
    inverse = np.linalg.pinv(normal, rcond=_RANK, hermitian=True)
    return np.asarray(np.sqrt(variance * np.maximum(np.diag(inverse), 0.0)))


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
    from scipy.sparse.linalg import spsolve

    gains, count = np.zeros(len(parts)), len(parts)
    free = np.ones(count, dtype=np.bool_)
    free[np.unique(parts, return_index=True)[1]] = False
    if not free.any():
        return gains
    coupled = _normal_matrix(o, weights, count)
    above = o.stops - _means(o.points, o.stops, weights)[o.points]
    wanted = np.bincount(o.photos, weights * above, count)
    gains[free] = spsolve(coupled[free][:, free], wanted[free], permc_spec="MMD_AT_PLUS_A")
    return gains


def _normal_matrix(o: Observations, weights: _Floats, count: int) -> "csc_array":
    """[V, V] the matrix of the normal equations of the gains, the points eliminated."""
    from scipy.sparse import coo_array

    of_points = np.bincount(o.points, weights)
    weight = coo_array((weights, (o.photos, o.points)), shape=(count, len(of_points))).tocsr()
    every = np.arange(count)
    own = coo_array((np.bincount(o.photos, weights, count), (every, every)))
    return (own.tocsr() - (weight * (1.0 / of_points)) @ weight.T).tocsc()


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

"""Relative brightness of a scene's photos, by a robust fit to SfM tracks.

The model is: stops of photo i at point j = gain_i + point_j, with Huber's loss and a mean gain of
0. The system is solved by iteratively reweighted least squares. The unknowns of the points are
eliminated first. The remaining matrix couples each photo with the photos that show some of the same
points. A strip of hundreds of photos has few such photos for each photo. Conjugate gradients would
then need many iterations, so the matrix is solved directly. If each photo is coupled with many
photos, conjugate gradients need few iterations, and a direct solution is slow. If the photos form
several groups without common points, the mean gain of each group is 0.
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


#: Minimum number of usable observations of a photo for a gain.
LEAST = 8
#: The photos differ in exposure if the next three conditions hold. The standard deviation of the
#: gains is at least the first value, in stops. The standard deviation is at least the second value
#: times its standard error. The gains reduce the deviation of the observations by at least the
#: third value, a share (docs/exposure.md).
LEAST_SPREAD, LEAST_RATIO, LEAST_REDUCTION = 0.2, 4.0, 0.15
#: With at least this many photos, the photo farthest from the mean is ignored. All its points may
#: be on an object that the other photos do not show.
_ENOUGH = 5
#: Maximum number of photos whose gains are fitted separately for the decision. If a scene has more
#: photos, consecutive photos are treated as one group, because they show the same points.
MOST_DECIDING, _CONSECUTIVE = 128, 8
# Cache of the gains, because a run needs them several times and a scene does not change.
_OF_TRAINING: "WeakKeyDictionary[Scene, TrackGains]" = WeakKeyDictionary()
_DECIDING: "WeakKeyDictionary[Scene, TrackGains]" = WeakKeyDictionary()
#: Huber's constant, in standard deviations. With this constant, the fit has an efficiency of 95 %
#: for normal errors.
_HUBER = 1.345
#: Ratio of the standard deviation to the median absolute deviation of a normal distribution.
_NORMAL = 1.4826
_ROUNDS = 12
#: Two limits for a direct solution: the maximum mean number of photos that share points with a
#: photo, and the minimum number of all photos. With fewer photos, the iterations converge quickly.
_FEW, _SHORT = 64, 64
#: Maximum error of the gains after the iterative solution, in stops.
_TOLERANCE = 1e-5
#: Standard errors are computed for at most this number of photos, because their computation needs a
#: dense matrix.
_DENSE = 512
#: Eigenvalues below this share of the largest eigenvalue count as 0. They belong to the mean gain
#: of a connected group of photos, which the observations do not determine.
_RANK = 1e-9
#: Residuals below this value, in stops, are rounding errors of 8-bit values.
_SMALLEST = 1e-3
_Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Fit:
    """The result of a fit: the relative brightness of photos.

    Attributes:
        gains: [V] stops of each photo above their mean; 0 without observations.
        before: Mean distance of the observations from the means of their points before the fit,
            stops. Each point is weighted by the variance of the gains of the photos that show it,
            because a point tests only differences between its own photos.
        after: The mean distance after the gains are subtracted, stops.
        errors: [V] standard errors of the gains, stops; NaN if there are more than `_DENSE` photos.
    """

    gains: _Floats
    before: float
    after: float
    errors: _Floats

    @property
    def reduction(self) -> float:
        """The share of the deviation that the gains explain."""
        return 1.0 - self.after / self.before if self.before > 0.0 else 0.0


@dataclass(frozen=True, eq=False)
class TrackGains:
    """The relative brightness of photos at points that several photos show.

    Attributes:
        gains: [V] stops above the mean of the photos; 0 for photos without enough observations.
        counts: [V] number of usable observations.
        fit: The fit of the gains to the observations.
    """

    gains: NDArray[np.float64]
    counts: NDArray[np.int64]
    fit: Fit

    @property
    def known(self) -> NDArray[np.bool_]:
        """[V] True for photos with enough usable observations."""
        return self.counts >= LEAST

    @property
    def spread(self) -> float:
        """Standard deviation of the gains, stops."""
        return float(self.gains[self.known].std()) if self.known.any() else 0.0

    @property
    def error(self) -> float:
        """Root mean square of the standard errors of the gains, stops."""
        errors = self.fit.errors[self.known]
        return float(np.sqrt(np.square(errors).mean())) if len(errors) else 0.0

    @property
    def differ(self) -> bool:
        """True if the photos differ in exposure by the three conditions."""
        sure = self.spread >= LEAST_RATIO * self.error
        return sure and self._lasting >= LEAST_SPREAD and self.fit.reduction >= LEAST_REDUCTION

    @property
    def _lasting(self) -> float:
        """The standard deviation without the photo farthest from the mean."""
        gains = self.gains[self.known]
        if len(gains) < _ENOUGH:
            return self.spread
        return float(np.delete(gains, np.argmax(np.abs(gains - gains.mean()))).std())

    @property
    def evidence(self) -> str:
        """The three compared values, as text."""
        gains = self.gains[self.known]
        if not len(gains):
            return "no SfM tracks connect the photos, so their brightness cannot be compared"
        error = f", standard error {self.error:.2f}" if isfinite(self.error) else ""
        return (
            f"brightness of {len(gains)} photos at {int(self.counts.sum()):,} "
            "observations of SfM points: gains with a standard deviation of "
            f"{self.spread:.2f} stops ({gains.min():+.2f} to {gains.max():+.2f}{error}); "
            "where points connect photos of different gains, the gains reduce the "
            f"deviation by {100.0 * self.fit.reduction:.0f} % ({self.fit.before:.2f} to "
            f"{self.fit.after:.2f} stops)"
        )


def track_gains(scene: Scene, views: Sequence[View]) -> TrackGains:
    """Fit the gains of the photos of some views."""
    observations = observations_of(scene, views)
    fit = fitted(observations, len(views))
    counts = np.bincount(observations.photos, minlength=len(views))
    known = counts >= LEAST
    gains = np.where(known, fit.gains - fit.gains[known].mean() if known.any() else 0.0, 0.0)
    return TrackGains(gains, counts, fit)


def training_gains(scene: Scene) -> TrackGains:
    """Return the gains of all training photos, from the cache if possible."""
    gains = _OF_TRAINING.get(scene)
    if gains is None:
        gains = _OF_TRAINING[scene] = track_gains(scene, scene.train_views)
    return gains


def deciding_gains(scene: Scene) -> TrackGains:
    """Return the gains that decide if the training photos differ, from the cache if possible."""
    views = scene.train_views
    if len(views) <= MOST_DECIDING:
        return training_gains(scene)
    gains = _DECIDING.get(scene)
    if gains is None:
        period = _CONSECUTIVE * len(views) // MOST_DECIDING
        chosen = [view for row, view in enumerate(views) if row % period < _CONSECUTIVE]
        gains = _DECIDING[scene] = track_gains(scene, chosen[:MOST_DECIDING])
    return gains


def fitted(observations: Observations, photos: int) -> Fit:
    """Fit the gains of `photos` photos to observations."""
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
    """Return [N] the variance of the gains of the photos that show each observation's point.

    All variances are 1 if no point is shown by photos with different gains.
    """
    even = np.ones(o.count)
    above = gains[o.photos] - _means(o.points, gains[o.photos], even)[o.points]
    variances = _means(o.points, above**2, even)[o.points]
    return variances if variances.any() else even


def _errors(
    o: Observations, weights: _Floats, residuals: _Floats, parts: NDArray[np.int64]
) -> _Floats:
    """Return the standard errors [V] of the gains by weighted least squares.

    If few points connect two groups of photos, the errors are large, even with many observations.
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
    """Return [V] the connected group of each photo; photos of a group are connected by points."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    size = photos + int(o.points.max()) + 1
    # Old versions of scipy require 32-bit indices for graphs.
    ends = o.photos.astype(np.int32), (photos + o.points).astype(np.int32)
    edges = coo_array((np.ones(o.count), ends), shape=(size, size))
    return np.asarray(connected_components(edges, directed=False)[1][:photos], dtype=np.int64)


def _means(points: NDArray[np.int64], values: _Floats, weights: _Floats) -> _Floats:
    """Return [N] the weighted mean at each observation's point."""
    return np.asarray(np.bincount(points, values * weights) / np.bincount(points, weights))


def _neighbours(o: Observations, photos: int) -> float:
    """Return the mean number of photos with shared points, including the photo itself."""
    from scipy.sparse import coo_array

    shape = photos, int(o.points.max()) + 1
    seen = coo_array((np.ones(o.count, np.int32), (o.photos, o.points)), shape=shape).tocsr()
    return float((seen @ seen.T).nnz) / photos


def _direct(o: Observations, weights: _Floats, parts: NDArray[np.int64]) -> _Floats:
    """Return the gains of weighted least squares by a direct solver.

    The first photo of each connected group has the gain 0.
    """
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
    """Return [V, V] the normal equations of the gains, after elimination of the points."""
    from scipy.sparse import coo_array

    of_points = np.bincount(o.points, weights)
    weight = coo_array((weights, (o.photos, o.points)), shape=(count, len(of_points))).tocsr()
    every = np.arange(count)
    diagonal = coo_array((np.bincount(o.photos, weights, count), (every, every)))
    return (diagonal.tocsr() - (weight * (1.0 / of_points)) @ weight.T).tocsc()


def _iterated(o: Observations, weights: _Floats, start: _Floats) -> _Floats:
    """Return the gains of weighted least squares by conjugate gradients (Jacobi preconditioner)."""
    count = len(start)
    diagonal = np.bincount(o.photos, weights, count)
    scale = 1.0 / np.maximum(diagonal, _SMALLEST)

    def deviations(values: _Floats) -> _Floats:
        """Return for each photo the sum of weighted deviations from the means of its points."""
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

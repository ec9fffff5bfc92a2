"""Relative brightness of the photos of a scene, by a robust fit to SfM tracks.

Model: stops of photo i at point j = gain_i + point_j, Huber's loss, mean gain 0. The system is
solved by iteratively reweighted least squares, with the points eliminated. The remaining matrix
couples each photo with the photos that show common points. If these photos are few, as in a strip
of hundreds of photos, the matrix is solved directly, because conjugate gradients would need many
iterations. If there are many such photos, conjugate gradients need few iterations and the direct
solution is slow. If the photos form several parts without common points, each part has a mean of 0.
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


#: Minimum number of usable observations for the gain of a photo.
LEAST = 8
#: Photos count as differing in exposure if three conditions hold. The standard deviation of the
#: gains is at least the first value, in stops. It is also at least the second value times its own
#: standard error. The gains reduce the deviation of observations by at least the third value, a
#: share (docs/exposure.md).
LEAST_SPREAD, LEAST_RATIO, LEAST_REDUCTION = 0.2, 4.0, 0.15
#: If there are at least this many photos, the photo farthest from the mean is ignored, because all
#: its points may be on an object that the other photos hide.
_ENOUGH = 5
#: Maximum number of photos for the decision. If there are more, groups of consecutive photos are
#: used, because consecutive photos show the same points.
MOST_DECIDING, _CONSECUTIVE = 128, 8
# The results are cached, because a run requests the gains several times and a scene does not
# change.
_OF_TRAINING: "WeakKeyDictionary[Scene, TrackGains]" = WeakKeyDictionary()
_DECIDING: "WeakKeyDictionary[Scene, TrackGains]" = WeakKeyDictionary()
#: Huber's constant in standard deviations. It gives an efficiency of 95 % for normal errors.
_HUBER = 1.345
#: Number of standard deviations of a normal distribution in one median absolute deviation.
_NORMAL = 1.4826
_ROUNDS = 12
#: The equations are solved directly if the mean number of photos that share points with a photo is
#: at most the first value, and the total number of photos is above the second value. With fewer
#: photos, iterations converge quickly.
_FEW, _SHORT = 64, 64
#: Maximum error of the gains after the iterations, in stops. The rounding error is smaller than
#: this.
_TOLERANCE = 1e-5
#: Standard errors are computed for at most this number of photos, because they need a dense matrix.
_DENSE = 512
#: Eigenvalues below this share of the largest eigenvalue count as 0. They belong to the mean gain
#: of a connected group of photos, which the observations do not determine.
_RANK = 1e-9
#: Residuals below this value, in stops, are rounding errors of 8-bit values.
_SMALLEST = 1e-3
_Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Fit:
    """The relative brightness of photos.

    Attributes:
        gains: [V] stops of each photo above their mean; 0 without observations.
        before: Mean distance of the observations from the means of their points, stops. A point
            is weighted by the variance of the gains of the photos that show it, because only
            points that join photos of different gains test these gains.
        after: The same distance after the gains are removed.
        errors: [V] standard errors of the gains, stops; NaN for more photos than `_DENSE`.
    """

    gains: _Floats
    before: float
    after: float
    errors: _Floats

    @property
    def reduction(self) -> float:
        """The share of the deviation that the gains remove."""
        return 1.0 - self.after / self.before if self.before > 0.0 else 0.0


@dataclass(frozen=True, eq=False)
class TrackGains:
    """The relative brightness of photos at points that several photos show.

    Attributes:
        gains: [V] stops above the mean of the photos; 0 without enough observations.
        counts: [V] usable observations.
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
        """Standard error of the gains, stops, root mean square over the photos."""
        errors = self.fit.errors[self.known]
        return float(np.sqrt(np.square(errors).mean())) if len(errors) else 0.0

    @property
    def differ(self) -> bool:
        """True if the photos differ in exposure, by the rule."""
        sure = self.spread >= LEAST_RATIO * self.error
        return sure and self._lasting >= LEAST_SPREAD and self.fit.reduction >= LEAST_REDUCTION

    @property
    def _lasting(self) -> float:
        """The spread without the photo farthest from the mean, if there are enough photos."""
        gains = self.gains[self.known]
        if len(gains) < _ENOUGH:
            return self.spread
        return float(np.delete(gains, np.argmax(np.abs(gains - gains.mean()))).std())

    @property
    def evidence(self) -> str:
        """The values that the rule compares, as text."""
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
    """Return the gains of all training photos; computed once per scene."""
    gains = _OF_TRAINING.get(scene)
    if gains is None:
        gains = _OF_TRAINING[scene] = track_gains(scene, scene.train_views)
    return gains


def deciding_gains(scene: Scene) -> TrackGains:
    """Return the gains that decide whether the training photos differ; computed once per scene."""
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
    """Fit the gains of `photos` photos."""
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
    """Return the variance [N] of the gains of the photos that show each observation's point.

    All variances are 1 if no point joins photos of different gains.
    """
    even = np.ones(o.count)
    above = gains[o.photos] - _means(o.points, gains[o.photos], even)[o.points]
    variances = _means(o.points, above**2, even)[o.points]
    return variances if variances.any() else even


def _errors(
    o: Observations, weights: _Floats, residuals: _Floats, parts: NDArray[np.int64]
) -> _Floats:
    """Return the standard errors [V] of the gains by weighted least squares.

    Groups of photos that few points connect have large errors, even with many observations.
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
    """Return the part [V] of each photo; the photos of a part are connected by common points."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    size = photos + int(o.points.max()) + 1
    # Graphs in older versions of scipy require 32-bit indices.
    ends = o.photos.astype(np.int32), (photos + o.points).astype(np.int32)
    edges = coo_array((np.ones(o.count), ends), shape=(size, size))
    return np.asarray(connected_components(edges, directed=False)[1][:photos], dtype=np.int64)


def _means(points: NDArray[np.int64], values: _Floats, weights: _Floats) -> _Floats:
    """Return the weighted mean of each observation's point [N]."""
    return np.asarray(np.bincount(points, values * weights) / np.bincount(points, weights))


def _neighbours(o: Observations, photos: int) -> float:
    """Return the mean number of photos that share points with a photo, itself included."""
    from scipy.sparse import coo_array

    shape = photos, int(o.points.max()) + 1
    seen = coo_array((np.ones(o.count, np.int32), (o.photos, o.points)), shape=shape).tocsr()
    return float((seen @ seen.T).nnz) / photos


def _direct(o: Observations, weights: _Floats, parts: NDArray[np.int64]) -> _Floats:
    """Return the gains of least weighted squares, by a direct solver.

    The first photo of each part has the gain 0.
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
    """Return the matrix [V, V] of the normal equations of the gains, the points eliminated."""
    from scipy.sparse import coo_array

    of_points = np.bincount(o.points, weights)
    weight = coo_array((weights, (o.photos, o.points)), shape=(count, len(of_points))).tocsr()
    every = np.arange(count)
    diagonal = coo_array((np.bincount(o.photos, weights, count), (every, every)))
    return (diagonal.tocsr() - (weight * (1.0 / of_points)) @ weight.T).tocsc()


def _iterated(o: Observations, weights: _Floats, start: _Floats) -> _Floats:
    """Return the gains of least weighted squares, by conjugate gradients (Jacobi)."""
    count = len(start)
    diagonal = np.bincount(o.photos, weights, count)
    scale = 1.0 / np.maximum(diagonal, _SMALLEST)

    def deviations(values: _Floats) -> _Floats:
        """Sum each photo's weighted deviations from the means of its points."""
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

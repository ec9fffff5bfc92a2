"""How much the brightness of SfM points depends on the viewing direction."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import Scene
from crossgrad_plugins.exposures.tracks.gains import fitted
from crossgrad_plugins.exposures.tracks.observations import Observations, observations_of

#: Minimum number of observations of a track: twice the number of coefficients of degree 1. Minimum
#: radius, in degrees, of the cone that contains the track's viewing directions.
LEAST_OBSERVATIONS: Final = 8
LEAST_RADIUS: Final = 10.0
#: Minimum number of tracks for a useful interval, and maximum number of tracks that are used.
FEWEST_TRACKS: Final = 100
_MOST_TRACKS: Final = 3_000
#: Regularization of the coefficients of degree 1, relative to the number of observations. It is
#: needed because directions in a narrow cone are nearly equal.
_RIDGE: Final = 0.01
_DRAWS: Final = 400

_Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ViewDependence:
    """How much of the brightness of tracks a view dependence of degree 1 explains.

    Differences in exposure are removed before.

    Attributes:
        tracks: Number of tracks that were observed from enough directions.
        share: Share of the variance of left-out observations that degree 1 explains. It is negative
            if degree 1 predicts worse than the mean, and NaN without tracks.
        low: Lower end of the 95 % interval of `share`, by a bootstrap over tracks.
        high: Upper end of the 95 % interval of `share`.
    """

    tracks: int
    share: float
    low: float
    high: float


def view_dependence(scene: Scene) -> ViewDependence:
    """Measure the view dependence of the tracks of the training photos.

    Every observation of a track is predicted from the track's other observations in two forms: by
    their mean, and by a linear function of the direction. Differences in exposure are removed
    before.

    Raises:
        UserError: A photo cannot be decoded.
    """
    views = scene.train_views
    observations = observations_of(scene, views)
    if not observations.count:
        return _share(np.zeros((0, 2)))
    stops = observations.stops - fitted(observations, len(views)).gains[observations.photos]
    directions = (
        scene.centers[observations.photos] - scene.points[observations.rows[observations.points]]
    )
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    directions = np.divide(directions, lengths, out=np.zeros_like(directions), where=lengths > 0.0)
    tracks = _tracks(observations)
    errors = [_errors(stops[indices], directions[indices]) for indices in tracks]
    return _share(np.concatenate([np.zeros((0, 2)), *errors])[:_MOST_TRACKS])


def _tracks(observations: Observations) -> Iterator[NDArray[np.int64]]:
    """Yield the observations [T, n] of tracks with n observations, for each sufficient n."""
    order = np.argsort(observations.points, kind="stable")
    lengths = np.bincount(observations.points)
    starts = np.cumsum(lengths) - lengths
    for length in sorted(set(lengths[lengths >= LEAST_OBSERVATIONS].tolist()), reverse=True):
        yield order[starts[lengths == length][:, None] + np.arange(length)]


def _errors(stops: _Floats, directions: _Floats) -> _Floats:
    """Return [T', 2] mean squared errors of both predictions for tracks with a wide enough cone.

    Args:
        stops: [T, n] brightness of the observations, in stops.
        directions: [T, n, 3] unit viewing directions.
    """
    count = stops.shape[1]
    mean = directions.mean(axis=1, keepdims=True)
    wide = np.linalg.norm(mean[:, 0], axis=1) <= np.cos(np.radians(LEAST_RADIUS))
    y = (stops - stops.mean(axis=1, keepdims=True))[wide]
    x = (directions - mean)[wide]
    square = np.einsum("tni,tnj->tij", x, x) + _RIDGE * count * np.eye(3)
    hat = x @ np.linalg.solve(square, x.transpose(0, 2, 1)) + 1.0 / count
    left_out = 1.0 - np.einsum("tnn->tn", hat)
    plane = (y - np.einsum("tnm,tm->tn", hat, y)) / left_out
    constant = y / (1.0 - 1.0 / count)
    return np.stack([(constant**2).mean(axis=1), (plane**2).mean(axis=1)], axis=1)


def _share(errors: _Floats) -> ViewDependence:
    """Return the explained share with its interval, from the errors [T, 2] of the tracks."""
    count = len(errors)
    if not errors[:, 0].sum() > 0.0:
        return ViewDependence(count, float("nan"), float("nan"), float("nan"))
    rng = np.random.default_rng(0)
    drawn = [errors[rng.integers(0, count, count)].sum(axis=0) for _ in range(_DRAWS)]
    sums = np.array([total for total in drawn if total[0] > 0.0])
    low, high = np.percentile(1.0 - sums[:, 1] / sums[:, 0], [2.5, 97.5])
    constant, plane = errors.sum(axis=0)
    return ViewDependence(count, float(1.0 - plane / constant), float(low), float(high))

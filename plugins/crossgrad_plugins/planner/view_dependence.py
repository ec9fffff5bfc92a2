"""How much the brightness of SfM points depends on the direction from which they are seen."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import Scene
from crossgrad_plugins.exposures.tracks.gains import fitted
from crossgrad_plugins.exposures.tracks.observations import Observations, observations_of

#: Observations of a track, twice the coefficients of degree 1, and the radius in degrees of the
#: cone of its directions, without which it cannot tell.
LEAST_OBSERVATIONS: Final = 8
LEAST_RADIUS: Final = 10.0
#: Tracks without which an interval says little, and those that are looked at, at most.
FEWEST_TRACKS: Final = 100
_MOST_TRACKS: Final = 3_000
#: Of the coefficients of degree 1, relative to the number of observations: directions of a narrow
#: cone are nearly the same.
_RIDGE: Final = 0.01
_DRAWS: Final = 400

_Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ViewDependence:
    """The share of the brightness of tracks that degree 1 explains, beyond exposure.

    Attributes:
        tracks: Tracks that were seen from enough directions.
        share: Share of the variance that degree 1 explains of an observation that was left out;
            negative where it explains less than nothing, NaN without tracks.
        low: Lower end of its 95 % interval, tracks resampled.
        high: The upper one.
    """

    tracks: int
    share: float
    low: float
    high: float


def view_dependence(scene: Scene) -> ViewDependence:
    """The view dependence of the tracks of the training photos.

    Of each track that is seen from enough directions, every observation is predicted from the
    others: by their mean, and by a plane over the directions. Exposures are taken out before.

    Raises:
        UserError: A photo cannot be decoded.
    """
    views = scene.train_views
    found = observations_of(scene, views)
    if not found.count:
        return _share(np.zeros((0, 2)))
    stops = found.stops - fitted(found, len(views)).gains[found.photos]
    directions = scene.centers[found.photos] - scene.points[found.rows[found.points]]
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    directions = np.divide(directions, lengths, out=np.zeros_like(directions), where=lengths > 0.0)
    tracks = _tracks(found)
    errors = [_errors(stops[each], directions[each]) for each in tracks]
    return _share(np.concatenate([np.zeros((0, 2)), *errors])[:_MOST_TRACKS])


def _tracks(found: Observations) -> Iterator[NDArray[np.int64]]:
    """[T, n] observations of the tracks of each length n that is enough, the longest first."""
    order = np.argsort(found.points, kind="stable")
    lengths = np.bincount(found.points)
    starts = np.cumsum(lengths) - lengths
    for length in sorted(set(lengths[lengths >= LEAST_OBSERVATIONS].tolist()), reverse=True):
        yield order[starts[lengths == length][:, None] + np.arange(length)]


def _errors(stops: _Floats, directions: _Floats) -> _Floats:
    """[T', 2] mean squared errors of both predictions of each track that is wide enough.

    Args:
        stops: [T, n].
        directions: [T, n, 3] unit vectors.
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
    """The share with its interval, from the errors [T, 2] of the tracks."""
    count = len(errors)
    if not errors[:, 0].sum() > 0.0:
        return ViewDependence(count, float("nan"), float("nan"), float("nan"))
    rng = np.random.default_rng(0)
    drawn = [errors[rng.integers(0, count, count)].sum(axis=0) for _ in range(_DRAWS)]
    sums = np.array([each for each in drawn if each[0] > 0.0])
    low, high = np.percentile(1.0 - sums[:, 1] / sums[:, 0], [2.5, 97.5])
    constant, plane = errors.sum(axis=0)
    return ViewDependence(count, float(1.0 - plane / constant), float(low), float(high))

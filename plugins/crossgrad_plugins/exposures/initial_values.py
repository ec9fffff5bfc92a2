"""Initial exposure of each training photo, from SfM tracks, EXIF, or neighbours."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from statistics import fmean, median
from typing import TYPE_CHECKING, Literal, TypeAlias
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import Camera, Scene, View
from crossgrad_plugins.exposures.exif import exposure_values
from crossgrad_plugins.exposures.tracks.gains import training_gains

if TYPE_CHECKING:
    from scipy.spatial import cKDTree


#: Sources of the initial exposure values.
Start: TypeAlias = Literal["auto", "tracks", "exif", "none"]
#: Photos are reported if their exposure differs from the mean by more than this many stops, because
#: their usable pixel values hardly overlap with other photos.
_FAR = 4.0
_NAMED = 3
#: Maximum number of neighbouring photos that predict the exposure of a photo.
TELLING = 4
#: With at most this number of photos, neighbours and regimes cannot be compared as predictors.
_SAME = 2
#: Lower bound of a distance between photos, so that a photo that was taken twice does not get all
#: the weight.
_NEAREST = 1e-3
_Floats: TypeAlias = NDArray[np.float64]
# Cache of the neighbours, because a run predicts each held-out photo at every evaluation, and
# scenes do not change.
_KNOWN: "WeakKeyDictionary[Scene, Neighbours]" = WeakKeyDictionary()


@dataclass(frozen=True, eq=False)
class Starts:
    """The initial gains of the training photos.

    Attributes:
        stops: [P] stops above the mean of the training photos.
        messages: Lines of the log about the source of the gains and about unusual photos.
    """

    stops: NDArray[np.float64]
    messages: tuple[str, ...]


def starts_of(scene: Scene, start: Start) -> Starts:
    """Return the initial gains of the training photos.

    Args:
        scene: The scene.
        start: `tracks` or `exif` for one source; `auto` for both, first tracks; `none` for gains of
            0.
    """
    names = [view.name for view in scene.train_views]
    if len(names) == 1:
        return Starts(
            np.zeros(1),
            ("exposure: there is only one training photo, so there are no differences",),
        )
    tracks = training_gains(scene) if start in {"auto", "tracks"} else None
    exif_stops = exposure_values(scene) if start in {"auto", "exif"} else {}
    of_tracks: dict[str, float] = {}
    if tracks is not None:
        photo_gains = zip(names, tracks.gains, tracks.known, strict=True)
        of_tracks = {name: float(gain) for name, gain, is_known in photo_gains if is_known}
    of_exif = _beside({name: exif_stops[name] for name in names if name in exif_stops}, of_tracks)
    by_name = {**of_exif, **of_tracks}
    rest = [name for name in names if name not in by_name]
    stops, by = _filled(np.array([by_name.get(name, np.nan) for name in names]), scene.train_views)
    stops -= stops.mean()
    messages = [] if tracks is None else [f"exposure: {tracks.evidence}"]
    messages += _reported_by("EXIF", [name for name in of_exif if name not in of_tracks])
    if start != "none":
        messages += _reported_by(f"{by}, because there are no usable tracks and no EXIF data", rest)
    messages += outliers(names, stops)
    if scene.test_views and neighbours_of(scene).tell(stops[:, None]):
        near, regime = neighbours_of(scene).errors(stops[:, None])
        messages.append(
            "exposure: held-out photos without EXIF data get the exposure of the "
            "training photos with the nearest poses: leave-one-out error on training "
            f"photos {near:.2f} stops (root mean square), with the mean of the regime "
            f"{regime:.2f}"
        )
    return Starts(stops, tuple(messages))


def _beside(exif_stops: dict[str, float], of_tracks: dict[str, float]) -> dict[str, float]:
    """Shift stops from EXIF to the scale of the tracks; without common photos, to a mean of 0."""
    if not exif_stops:
        return {}
    both = [of_tracks[name] - value for name, value in exif_stops.items() if name in of_tracks]
    shift = median(both) if both else -fmean(exif_stops.values())
    return {name: value + shift for name, value in exif_stops.items()}


def _filled(stops: NDArray[np.float64], views: Sequence[View]) -> tuple[NDArray[np.float64], str]:
    """Replace NaN by the prediction of neighbours or regimes, and return the kind of prediction."""
    known_rows = np.flatnonzero(~np.isnan(stops)).tolist()
    of_regime = "the mean of their regime"
    if not len(known_rows):
        return np.zeros_like(stops), of_regime
    filled = stops.copy()
    missing = np.flatnonzero(np.isnan(stops)).tolist()
    neighbours, known_stops = Neighbours([views[row] for row in known_rows]), stops[known_rows]
    if neighbours.tell(known_stops[:, None]):
        for row in missing:
            rows, weights = neighbours.rows_and_weights(views[row].camera)
            filled[row] = weights @ known_stops[rows]
        return filled, "the photos with the nearest poses"
    for row in missing:
        in_regime = [other for other in known_rows if views[other].regime == views[row].regime]
        filled[row] = stops[in_regime or known_rows].mean()
    return filled, of_regime


def _reported_by(source: str, names: Sequence[str]) -> Iterable[str]:
    if names:
        yield (
            f"exposure: the initial values of {len(names)} photos come from {source} "
            f"({_some(names)})"
        )


def outliers(names: Sequence[str], stops: Iterable[float]) -> Iterable[str]:
    """Yield a message if some photos have stops far from the mean."""
    far = [name for name, stop in zip(names, stops, strict=True) if abs(stop) > _FAR]
    if far:
        yield (
            f"exposure: {len(far)} photos differ by more than {_FAR:g} stops from the "
            f"mean ({_some(far)}); they are almost black or white, and leaving them out "
            "may give better results"
        )


def _some(names: Sequence[str]) -> str:
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return ", ".join(names[:_NAMED]) + more


class Neighbours:
    """Predictions of a photo's values from the photos with similar camera poses.

    The squared distance of two cameras is the sum of two terms. The first is the squared distance
    of their centres, in units of the median distance from the middle. The second is the squared
    distance of their unit viewing directions.
    """

    def __init__(self, views: Sequence[View]) -> None:
        cameras = [view.camera for view in views]
        centers = np.array([camera.center.numpy() for camera in cameras])
        self._middle = np.median(centers, axis=0)
        distance = float(np.median(np.linalg.norm(centers - self._middle, axis=1)))
        self._scale = distance if distance > 0.0 else 1.0
        self._places = np.array([self._place(camera) for camera in cameras])
        self._regimes = np.unique([view.regime for view in views], return_inverse=True)[1]

    def rows_and_weights(self, camera: Camera) -> tuple[NDArray[np.int64], _Floats]:
        """Return the photos [N] that predict a photo of this camera, and weights of sum 1."""
        rows, weights = self._told(self._place(camera)[None], min(TELLING, len(self._places)))
        return rows[0], weights[0]

    def errors(self, values: _Floats) -> tuple[float, float]:
        """Return the root mean square leave-one-out errors of two predictions.

        Args:
            values: [P, V] values of the photos, P > 1.

        Returns:
            The error of the prediction by neighbours, and the error of the prediction by the mean
            of the other photos in the regime. If a regime has only one photo, the mean of all other
            photos is used.
        """
        rows, weights = self._others
        near = (weights[..., None] * values[rows]).sum(axis=1)
        predictions = (near, self._means(values))
        of_near, of_regime = (
            float(np.sqrt(np.square(prediction - values).mean())) for prediction in predictions
        )
        return of_near, of_regime

    def tell(self, values: _Floats) -> bool:
        """Return True if neighbouring photos predict a photo's values better than its regime.

        The prediction of a regime is the mean of its values.

        With only two photos, return False.
        """
        if len(values) <= _SAME:
            return False
        of_near, of_regime = self.errors(values)
        return of_near < of_regime

    def _place(self, camera: Camera) -> _Floats:
        """Return position and viewing direction [6] of a camera."""
        looks = camera.world_to_camera[2, :3].numpy()
        return np.concatenate([(camera.center.numpy() - self._middle) / self._scale, looks])

    @cached_property
    def _others(self) -> tuple[NDArray[np.int64], _Floats]:
        """The other photos [P, N] that predict each photo, and their weights."""
        count = min(TELLING + 1, len(self._places))
        rows, weights = self._told(self._places, count)
        # Photos at one position come in any order, so remove the photo itself wherever it is in the
        # list.
        weights[rows == np.arange(len(rows))[:, None]] = 0.0
        return rows, weights / weights.sum(axis=1, keepdims=True)

    @cached_property
    def _tree(self) -> "cKDTree":
        from scipy.spatial import cKDTree

        return cKDTree(self._places)

    def _told(self, places: _Floats, count: int) -> tuple[NDArray[np.int64], _Floats]:
        distances, rows = self._tree.query(places, k=np.arange(1, count + 1))
        weights = 1.0 / np.maximum(distances, _NEAREST)
        return rows, weights / weights.sum(axis=1, keepdims=True)

    def _means(self, values: _Floats) -> _Floats:
        """Return the means [P, V] of the values of the other photos in each photo's regime."""
        sums = np.zeros((self._regimes.max() + 1, values.shape[1]))
        np.add.at(sums, self._regimes, values)
        counts = np.bincount(self._regimes)[self._regimes][:, None]
        of_regime = (sums[self._regimes] - values) / np.maximum(counts - 1, 1)
        of_all = (values.sum(axis=0) - values) / (len(values) - 1)
        return np.where(counts > 1, of_regime, of_all)


def neighbours_of(scene: Scene) -> Neighbours:
    """Return the neighbours among the training photos of a scene, from the cache if possible."""
    neighbours = _KNOWN.get(scene)
    if neighbours is None:
        neighbours = _KNOWN[scene] = Neighbours(scene.train_views)
    return neighbours

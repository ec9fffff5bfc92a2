"""Where the exposure of each training photo starts: SfM tracks, EXIF, or neighbours."""

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


#: What a start is taken from.
Start: TypeAlias = Literal["auto", "tracks", "exif", "none"]
#: Photos so many stops from the mean share hardly any usable value with the others.
_FAR = 4.0
_NAMED = 3
#: Photos that one is told from, at most.
TELLING = 4
#: Of so many photos each is told by all others, both ways.
_SAME = 2
#: Distances below it count alike, so that a photo taken twice does not outweigh all others.
_NEAREST = 1e-3
_Floats: TypeAlias = NDArray[np.float64]
# A run asks for each held-out photo at every evaluation, and a scene does not change.
_KNOWN: "WeakKeyDictionary[Scene, Neighbours]" = WeakKeyDictionary()


@dataclass(frozen=True, eq=False)
class Starts:
    """The gains at the start.

    Attributes:
        stops: [P] stops above the mean of the training photos.
        messages: Where they come from, and what is unusual about them.
    """

    stops: NDArray[np.float64]
    messages: tuple[str, ...]


def starts_of(scene: Scene, start: Start) -> Starts:
    """The gains of the training photos at the start.

    Args:
        scene: The scene.
        start: `tracks` or `exif` alone, `auto` both, tracks first; `none` starts from 0.
    """
    names = [view.name for view in scene.train_views]
    if len(names) == 1:
        return Starts(np.zeros(1), ("exposure: one training photo has no other to differ from",))
    tracks = training_gains(scene) if start in {"auto", "tracks"} else None
    told = exposure_values(scene) if start in {"auto", "exif"} else {}
    of_tracks: dict[str, float] = {}
    if tracks is not None:
        known = zip(names, tracks.gains, tracks.known, strict=True)
        of_tracks = {name: float(gain) for name, gain, is_known in known if is_known}
    of_exif = _beside({name: told[name] for name in names if name in told}, of_tracks)
    found = {**of_exif, **of_tracks}
    rest = [name for name in names if name not in found]
    stops, by = _filled(np.array([found.get(name, np.nan) for name in names]), scene.train_views)
    stops -= stops.mean()
    messages = [] if tracks is None else [f"exposure: {tracks.evidence}"]
    messages += _reported_by("EXIF", [name for name in of_exif if name not in of_tracks])
    if start != "none":
        messages += _reported_by(f"{by}, for want of usable tracks and EXIF", rest)
    messages += outliers(names, stops)
    if scene.test_views and neighbours_of(scene).tell(stops[:, None]):
        near, regime = neighbours_of(scene).errors(stops[:, None])
        messages.append(
            "exposure: held-out photos without EXIF are told from the training photos nearest in "
            f"pose: off by {near:.2f} stops (root mean square) where each training photo is left "
            f"out, the mean of its regime by {regime:.2f}"
        )
    return Starts(stops, tuple(messages))


def _beside(told: dict[str, float], of_tracks: dict[str, float]) -> dict[str, float]:
    """EXIF's stops on the scale of the tracks, or around their own mean where there are none."""
    if not told:
        return {}
    both = [of_tracks[name] - value for name, value in told.items() if name in of_tracks]
    shift = median(both) if both else -fmean(told.values())
    return {name: value + shift for name, value in told.items()}


def _filled(stops: NDArray[np.float64], views: Sequence[View]) -> tuple[NDArray[np.float64], str]:
    """NaN replaced by what neighbours or regimes tell, and by which of them."""
    known = np.flatnonzero(~np.isnan(stops)).tolist()
    of_regime = "the mean of their regime"
    if not len(known):
        return np.zeros_like(stops), of_regime
    filled = stops.copy()
    missing = np.flatnonzero(np.isnan(stops)).tolist()
    neighbours, told = Neighbours([views[row] for row in known]), stops[known]
    if neighbours.tell(told[:, None]):
        for row in missing:
            rows, weights = neighbours.rows_and_weights(views[row].camera)
            filled[row] = weights @ told[rows]
        return filled, "the photos nearest in pose"
    for row in missing:
        own = [each for each in known if views[each].regime == views[row].regime]
        filled[row] = stops[own or known].mean()
    return filled, of_regime


def _reported_by(source: str, names: Sequence[str]) -> Iterable[str]:
    if names:
        yield f"exposure: {len(names)} photos start from {source} ({_some(names)})"


def outliers(names: Sequence[str], stops: Iterable[float]) -> Iterable[str]:
    """What there is to say of photos, each with its stops from the mean."""
    far = [name for name, stop in zip(names, stops, strict=True) if abs(stop) > _FAR]
    if far:
        yield (
            f"exposure: {len(far)} photos are more than {_FAR:g} stops from the mean "
            f"({_some(far)}): little of what they show can be told from black or white; leaving "
            "them out may be better"
        )


def _some(names: Sequence[str]) -> str:
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return ", ".join(names[:_NAMED]) + more


class Neighbours:
    """Some photos by where they were taken and where they look.

    The distance of two cameras is that of their centres, in median distances from the middle of
    all, and that of their unit viewing directions, squared and added.
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
        """The photos [N] that tell of one with this camera, and their weights, of sum 1."""
        rows, weights = self._told(self._place(camera)[None], min(TELLING, len(self._places)))
        return rows[0], weights[0]

    def errors(self, values: _Floats) -> tuple[float, float]:
        """How far off a photo would be had it been left out, by root mean square.

        Args:
            values: [P, V] of the photos, P > 1.

        Returns:
            Told by its neighbours; by the mean over the others of its regime, over all others
            where it has none.
        """
        rows, weights = self._others
        near = (weights[..., None] * values[rows]).sum(axis=1)
        told = (near, self._means(values))
        of_near, of_regime = (float(np.sqrt(np.square(each - values).mean())) for each in told)
        return of_near, of_regime

    def tell(self, values: _Floats) -> bool:
        """Whether neighbours tell more of each other than regimes do; of two photos, neither."""
        if len(values) <= _SAME:
            return False
        of_near, of_regime = self.errors(values)
        return of_near < of_regime

    def _place(self, camera: Camera) -> _Floats:
        """[6] where a camera stands and looks."""
        looks = camera.world_to_camera[2, :3].numpy()
        return np.concatenate([(camera.center.numpy() - self._middle) / self._scale, looks])

    @cached_property
    def _others(self) -> tuple[NDArray[np.int64], _Floats]:
        """[P, N] the other photos that tell of each, and their weights."""
        count = min(TELLING + 1, len(self._places))
        rows, weights = self._told(self._places, count)
        # Photos taken in one place may come in any order: a photo is itself wherever it comes.
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
        """[P, V] means over the others of each photo's regime."""
        sums = np.zeros((self._regimes.max() + 1, values.shape[1]))
        np.add.at(sums, self._regimes, values)
        counts = np.bincount(self._regimes)[self._regimes][:, None]
        of_regime = (sums[self._regimes] - values) / np.maximum(counts - 1, 1)
        of_all = (values.sum(axis=0) - values) / (len(values) - 1)
        return np.where(counts > 1, of_regime, of_all)


def neighbours_of(scene: Scene) -> Neighbours:
    """Those among the training photos of a scene, worked out once for it."""
    found = _KNOWN.get(scene)
    if found is None:
        found = _KNOWN[scene] = Neighbours(scene.train_views)
    return found

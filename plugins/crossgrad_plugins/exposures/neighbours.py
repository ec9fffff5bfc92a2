"""Values of a photo from those that were taken near it, looking the same way."""

from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, TypeAlias
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import Camera, Scene, View

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

#: Photos that one is told from, at most.
TELLING = 4
#: Of so many photos each is told by all others, both ways.
_SAME = 2
#: Distances below it count alike, so that a photo taken twice does not outweigh all others.
_NEAREST = 1e-3

_Floats: TypeAlias = NDArray[np.float64]

# A run asks for each held-out photo at every evaluation, and a scene does not change.
_KNOWN: "WeakKeyDictionary[Scene, Neighbours]" = WeakKeyDictionary()


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

"""How deep a photo is where none of its SfM points lies: a plane, and what is near it bends it."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import Camera

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

#: Neighbours whose distance from the plane counts.
_NEIGHBOURS = 8
#: In parts of the longer side: below the first all distances count alike; a point as far away as
#: the second is worth as much as the plane.
_BLUR, _REACH = 0.02, 0.1
#: Farther than so many times its farthest points a photo is not deep.
_FARTHEST = 2.0
#: Of the farthest camera or point: how far away the sky is.
_SKY = 2.0
#: Share of the points that may lie nearer, or farther, than any added one.
_TAIL = 0.02
#: Huber's constant, for 95 % of the efficiency of least squares.
_HUBER, _PASSES = 1.345, 10


@dataclass(frozen=True, eq=False)
class Sky:
    """Where the sky of a scene is.

    Attributes:
        up: [3] the scene's upward axis, unit, local frame.
        centers: [V, 3] of the cameras.
        points: [P, 3] SfM points, or some of them.
        most: Share of the points that do not lie astray.
    """

    up: NDArray[np.float64]
    centers: NDArray[np.float64]
    points: NDArray[np.float64]
    most: float

    def depth(self, camera: Camera) -> float:
        """How far away it is: behind everything that the camera could see of the scene."""
        center = camera.center.numpy()
        far = float(np.linalg.norm(self.centers - center, axis=1).max())
        if len(self.points):
            ways = np.linalg.norm(self.points - center, axis=1)
            far = max(far, float(np.quantile(ways, self.most)))
        return _SKY * far

    def rise(self, camera: Camera) -> NDArray[np.float64]:
        """[3] over (x, y, 1) of `from_the_middle`: how steeply the rays through pixels go up."""
        across, down, ahead = camera.world_to_camera[:3, :3].numpy() @ self.up
        side = max(camera.width, camera.height)
        x, y = camera.width / 2.0 - camera.cx, camera.height / 2.0 - camera.cy
        upright = ahead + across * x / camera.fx + down * y / camera.fy
        return np.array([across * side / camera.fx, down * side / camera.fy, upright])


@dataclass(frozen=True, eq=False)
class Depth:
    """Depth of a photo, from the points that it observed.

    Of a plane in space the inverse depth is a plane over the pixels, so that ground goes on beyond
    its last point, up to the horizon. Rays that go up and do not meet the plane end in the sky.

    Attributes:
        pixels: [S, 2] of the points, in units of the longer side from the middle.
        inverse: [S] their inverse depths.
        median: Median of their depths.
        nearest: Largest inverse depth of an added point.
        farthest: Smallest inverse depth of an added point that is not of the sky.
        rise: [3] how steeply rays go up, over (x, y, 1).
        sky: Depth of the sky.
    """

    pixels: NDArray[np.float64]
    inverse: NDArray[np.float64]
    median: float
    nearest: float
    farthest: float
    rise: NDArray[np.float64]
    sky: float

    @classmethod
    def of(
        cls, camera: Camera, points: NDArray[np.float64], fewest: int, sky: Sky
    ) -> "Depth | None":
        """From the points [S, 3] that were observed; None with fewer than `fewest` in front."""
        pixels, depth = camera.project(points)
        ahead = depth > 0.0
        if np.count_nonzero(ahead) < fewest:
            return None
        around, inverse = from_the_middle(camera, pixels[ahead]), 1.0 / depth[ahead]
        far, near = np.quantile(inverse, [_TAIL, 1.0 - _TAIL])
        median, farthest = float(np.median(depth[ahead])), far / _FARTHEST
        far_away = max(sky.depth(camera), 1.0 / farthest)
        return cls(around, inverse, median, near, farthest, sky.rise(camera), far_away)

    @cached_property
    def plane(self) -> NDArray[np.float64]:
        """[3] inverse depth over (x, y, 1)."""
        return _plane(self.pixels, self.inverse)

    @cached_property
    def rest(self) -> NDArray[np.float64]:
        """[S] the points' inverse depths less the plane's."""
        return self.inverse - _on(self.plane, self.pixels)

    @cached_property
    def _tree(self) -> "cKDTree":
        from scipy.spatial import cKDTree

        return cKDTree(self.pixels)

    def rises(self, around: NDArray[np.float64]) -> NDArray[np.bool_]:
        """[N] whether rays through pixels [N, 2], as of `from_the_middle`, go up."""
        return _on(self.rise, around) > 0.0

    def at(self, around: NDArray[np.float64]) -> NDArray[np.float64]:
        """[N] depths at pixels [N, 2], in units of the longer side from the middle."""
        count = min(_NEIGHBOURS, len(self.rest))
        distances, rows = self._tree.query(around, k=[*range(1, count + 1)])
        weights = 1.0 / (distances**2 + _BLUR**2)
        bent = (weights * self.rest[rows]).sum(axis=1) / (weights.sum(axis=1) + _REACH**-2)
        inverse = _on(self.plane, around) + bent
        ground = 1.0 / np.clip(inverse, self.farthest, self.nearest)
        return np.where((inverse <= 0.0) & self.rises(around), self.sky, ground)


def from_the_middle(camera: Camera, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pixels [N, 2] in units of the photo's longer side, from its middle."""
    middle = np.array([camera.width, camera.height]) / 2.0
    return (pixels - middle) / max(camera.width, camera.height)


def _on(plane: NDArray[np.float64], around: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(around @ plane[:2] + plane[2])


def _plane(around: NDArray[np.float64], inverse: NDArray[np.float64]) -> NDArray[np.float64]:
    """[3] by Huber's loss, iteratively reweighted."""
    columns = np.column_stack([around, np.ones(len(around))])
    weights = np.ones(len(around))
    for _ in range(_PASSES):
        root = np.sqrt(weights)
        plane = np.linalg.lstsq(columns * root[:, None], inverse * root, rcond=None)[0]
        off = np.abs(inverse - columns @ plane)
        # Of normal noise the median deviation is 0.6745 sigma.
        limit = _HUBER * np.median(off) / 0.6745
        weights = np.minimum(1.0, np.divide(limit, off, out=np.ones_like(off), where=off > limit))
    return np.asarray(plane)

"""The depth of a photo between its SfM points: a plane, corrected by the nearest points."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import Camera

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

#: Number of neighbouring points that correct the depth of the plane at a pixel.
_NEIGHBOURS = 8
#: Distances between pixels, in units of the photo's longer side. All distances below `_BLUR` have
#: the same weight. A point at distance `_REACH` has the same weight as the plane.
_BLUR, _REACH = 0.02, 0.1
#: The largest depth in a photo, as a multiple of the depth of its farthest points.
_FARTHEST = 2.0
#: Distance of the sky, as a multiple of the distance of the farthest camera or point.
_SKY = 2.0
#: Share of the observed points that are nearer than the smallest depth of an added point. An equal
#: share of the points is left out at the far end, because single points are often wrong.
_TAIL = 0.02
#: Huber's constant, which gives the fit 95 % of the efficiency of least squares for normal noise,
#: and the number of reweighting passes.
_HUBER, _PASSES = 1.345, 10


@dataclass(frozen=True, eq=False)
class Sky:
    """The distance of the sky in a scene.

    Attributes:
        up: [3] the scene's upward axis, unit, local frame.
        centers: [V, 3] centres of the cameras.
        points: [P, 3] SfM points, or a sample of them.
        most: Quantile of the distances of the points that counts as their largest distance; the
            farther points are outliers.
    """

    up: NDArray[np.float64]
    centers: NDArray[np.float64]
    points: NDArray[np.float64]
    most: float

    def depth(self, camera: Camera) -> float:
        """Return the depth of the sky for a camera.

        The depth is a multiple of the distance to the farthest camera or point.
        """
        center = camera.center.numpy()
        far = float(np.linalg.norm(self.centers - center, axis=1).max())
        if len(self.points):
            ways = np.linalg.norm(self.points - center, axis=1)
            far = max(far, float(np.quantile(ways, self.most)))
        return _SKY * far

    def rise(self, camera: Camera) -> NDArray[np.float64]:
        """Return [3] the slope of the rays through pixels, as a linear function of (x, y, 1).

        x and y are pixel coordinates as returned by `from_the_middle`. The function is positive for
        rays that go up.
        """
        across, down, ahead = camera.world_to_camera[:3, :3].numpy() @ self.up
        side = max(camera.width, camera.height)
        x, y = camera.width / 2.0 - camera.cx, camera.height / 2.0 - camera.cy
        upright = ahead + across * x / camera.fx + down * y / camera.fy
        return np.array([across * side / camera.fx, down * side / camera.fy, upright])


@dataclass(frozen=True, eq=False)
class Depth:
    """Depth of a photo, estimated from the points that it observed.

    If the scene is a plane, its inverse depth is a linear function of the pixel. A plane is
    therefore fitted to the inverse depths, and the ground continues up to the horizon. Rays that go
    up and do not meet the plane end at the depth of the sky.

    Attributes:
        pixels: [S, 2] pixels of the points, in units of the longer side from the photo's centre.
        inverse: [S] inverse depths of the points.
        median: Median depth of the points.
        nearest: Largest inverse depth of an added point.
        farthest: Smallest inverse depth of an added point that is not sky.
        rise: [3] slope of the rays, as coefficients of a linear function of (x, y, 1).
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
        """Return the depth of a photo, or None if fewer than `fewest` points are in front.

        Args:
            camera: The photo's camera.
            points: [S, 3] the observed points.
            fewest: Minimum number of points in front of the camera.
            sky: The scene's sky.
        """
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
        """[3] inverse depth of the plane, as coefficients of a linear function of (x, y, 1)."""
        return _plane(self.pixels, self.inverse)

    @cached_property
    def rest(self) -> NDArray[np.float64]:
        """[S] residuals: inverse depths of the points minus the inverse depth of the plane."""
        return self.inverse - _on(self.plane, self.pixels)

    @cached_property
    def _tree(self) -> "cKDTree":
        from scipy.spatial import cKDTree

        return cKDTree(self.pixels)

    def rises(self, around: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return [N], True if the ray through a pixel goes up.

        Pixels [N, 2] are as in `from_the_middle`.
        """
        return _on(self.rise, around) > 0.0

    def at(self, around: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return [N] depths at pixels [N, 2], which are given as in `from_the_middle`."""
        count = min(_NEIGHBOURS, len(self.rest))
        distances, rows = self._tree.query(around, k=[*range(1, count + 1)])
        weights = 1.0 / (distances**2 + _BLUR**2)
        bent = (weights * self.rest[rows]).sum(axis=1) / (weights.sum(axis=1) + _REACH**-2)
        inverse = _on(self.plane, around) + bent
        ground = 1.0 / np.clip(inverse, self.farthest, self.nearest)
        return np.where((inverse <= 0.0) & self.rises(around), self.sky, ground)


def from_the_middle(camera: Camera, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return pixels [N, 2] relative to the photo's centre, divided by the photo's longer side."""
    middle = np.array([camera.width, camera.height]) / 2.0
    return (pixels - middle) / max(camera.width, camera.height)


def _on(plane: NDArray[np.float64], around: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(around @ plane[:2] + plane[2])


def _plane(around: NDArray[np.float64], inverse: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return [3] coefficients of the plane, fitted with Huber's loss by iterative reweighting."""
    columns = np.column_stack([around, np.ones(len(around))])
    weights = np.ones(len(around))
    for _ in range(_PASSES):
        root = np.sqrt(weights)
        plane = np.linalg.lstsq(columns * root[:, None], inverse * root, rcond=None)[0]
        off = np.abs(inverse - columns @ plane)
        # For normal noise, the median absolute deviation is 0.6745 times the standard deviation.
        limit = _HUBER * np.median(off) / 0.6745
        weights = np.minimum(1.0, np.divide(limit, off, out=np.ones_like(off), where=off > limit))
    return np.asarray(plane)

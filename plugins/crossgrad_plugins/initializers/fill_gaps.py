"""Additional Gaussians in parts of photos without SfM points, and beyond the edges of photos."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from crossgrad_core.plugin import Camera, Field, Initializer, MorePoints, Scene, View
from crossgrad_plugins.groupings.heights import upward
from crossgrad_plugins.initializers.cells import Cells
from crossgrad_plugins.initializers.depth import Depth, Sky, from_the_middle

#: Minimum number of observed points for an estimate of a photo's depth.
FEWEST: Final = 8
#: Standard deviation of an added Gaussian, as a share of the side length of its cell.
_SIZE: Final = 0.8
_NEAREST: Final = 3
#: A point is hidden in a photo if its depth is larger than this multiple of the photo's depth at
#: its pixel.
_BEHIND: Final = 1.5
#: A photo shows the ground below a camera if two conditions hold. The camera's depth in the photo
#: is at least `_GROUND` times the photo's depth at that pixel. The ray to the camera goes down with
#: a sine of at least `_STEEP`.
_GROUND, _STEEP = 0.75, 0.3
#: Number of points from which the extent of the scene is computed, and the share of them that are
#: not outliers.
_POINTS, _NOT_STRAY = 1000, 0.98


@dataclass(eq=False)
class _Filling:
    """The points of the scene and the points added so far.

    Attributes:
        points: [P, 3] positions of the scene's points and of the added points.
        sizes: [P] standard deviation of the Gaussian at each point, local units.
        colors: Colours of the added points, one array per call of `add`.
        inside: Number of points that were added inside photos.
        left_aside: Number of photos that were skipped because they observed too few points.
    """

    points: NDArray[np.float64]
    sizes: NDArray[np.float64]
    colors: list[NDArray[np.uint8]] = field(default_factory=list)
    inside: int = 0
    left_aside: int = 0

    def add(
        self,
        points: NDArray[np.float64],
        sizes: NDArray[np.float64],
        colors: NDArray[np.uint8],
    ) -> None:
        self.points = np.concatenate([self.points, points])
        self.sizes = np.concatenate([self.sizes, sizes])
        self.colors.append(colors)


#: Cache of the filled points of each scene and initializer. An entry is deleted together with its
#: scene.
_KNOWN: "WeakKeyDictionary[Scene, dict[Filled, _Filling]]" = WeakKeyDictionary()


class Filled(Initializer):
    """Adds Gaussians in cells of photos without points, and in a margin beyond the edges of photos.

    The depth of a photo is a plane through the points that the photo observed, corrected by the
    nearest points. A cell beyond a photo's edge is filled if no training photo shows it. The added
    Gaussian gets the colour at the photo's edge. Held-out photos and viewers then show continued
    ground instead of black holes. This method was developed for crossgrad.
    """

    cells: int = Field(12, ge=2, le=200, description="points along the longer side of a photo")
    margin: float = Field(
        0.5,
        ge=0.0,
        le=2.0,
        description="margin beyond each edge of the photo, as a share of its longer side; 0: none",
    )
    opacity: float = Field(0.5, gt=0.0, lt=1.0, description="opacity of the added Gaussians")
    views: int = Field(200, ge=1, description="maximum number of photos to fill")

    @override
    def more_points(self, scene: Scene) -> MorePoints | None:
        filling, existing = self._filling(scene), len(scene.points)
        added = len(filling.points) - existing
        if not added:
            return None
        return MorePoints(
            positions=filling.points[existing:],
            colors=np.concatenate(filling.colors),
            sizes=filling.sizes[existing:],
            opacities=np.full(added, self.opacity),
        )

    @override
    def messages(self, scene: Scene) -> tuple[str, ...]:
        filling = self._filling(scene)
        beyond = len(filling.points) - len(scene.points) - filling.inside
        aside = f"; {filling.left_aside} photos with fewer than {FEWEST} points were skipped"
        return (
            (
                f"start: {filling.inside} Gaussians added inside photos where there are no "
                f"points, {beyond} beyond the edges of "
                f"photos{(aside if filling.left_aside else '')}"
            ),
        )

    def _filling(self, scene: Scene) -> _Filling:
        cached = _KNOWN.setdefault(scene, {})
        if self not in cached:
            cached[self] = self._filled(scene)
        return cached[self]

    def _filled(self, scene: Scene) -> _Filling:
        filling = _Filling(scene.points, _spacings(scene.points))
        views, margin = _spread(scene.train_views, self.views), round(self.margin * self.cells)
        if not views:
            return filling
        sample = scene.points[:: -(-len(scene.points) // _POINTS) or 1]
        sky = Sky(upward(scene)[0], scene.robust_centers, sample, _NOT_STRAY)
        deep = {
            view: Depth.of(view.camera, scene.points[view.seen], FEWEST, sky)
            for view in (scene.train_views if margin else views)
        }
        with_depth = [(view, depth) for view in views if (depth := deep[view]) is not None]
        filling.left_aside = len(views) - len(with_depth)
        # Fill near photos first, because their added Gaussians are small and cover cells of far
        # photos too.
        with_depth.sort(key=lambda pair: pair[1].median)
        air = _Air.of(with_depth)
        for view, depth in with_depth:
            self._fill(filling, view, depth, air, 0, None)
        filling.inside = len(filling.points) - len(scene.points)
        if margin and with_depth:
            pictures = _Pictures.of(deep)
            # Leave out a camera if another photo shows the ground just below the camera. The depth
            # of that photo then determines which surroundings of the camera are visible.
            centers = np.stack([view.camera.center.numpy() for view, _ in with_depth])
            low = pictures.look_down_on(centers, sky.up)
            high = [pair for pair, inside in zip(with_depth, low, strict=True) if not inside]
            for view, depth in reversed(high):
                self._fill(filling, view, depth, air, margin, pictures)
        return filling

    def _fill(
        self,
        filling: _Filling,
        view: View,
        depth: Depth,
        air: "_Air",
        margin: int,
        seen: "_Pictures | None",
    ) -> None:
        """Fill empty cells of a photo, or cells beyond its edges that `seen` does not show.

        A point on a ray that goes up could float in the air near a camera. Inside the photo, a
        floating point is moved to the sky. Beyond the edges of the photo, a floating point is left
        out.
        """
        camera = view.camera
        cells = Cells(camera, max(camera.width, camera.height) / self.cells, margin)
        empty = ~cells.covered(filling.points, filling.sizes)
        if margin:
            empty &= ~cells.on_photo
        if not empty.any():
            return
        colors, has_pixels = cells.colors(view)
        rows = np.flatnonzero(empty & has_pixels)
        at = from_the_middle(camera, cells.pixels[rows])
        depths = depth.at(at)
        points = _behind(view, cells.pixels[rows], depths)
        floats = depth.rises(at) & air.holds(points)
        if seen is None:
            depths = np.where(floats, depth.sky, depths)
            points = _behind(view, cells.pixels[rows], depths)
        else:
            added = ~(floats | seen.show(points))
            rows, depths, points = rows[added], depths[added], points[added]
        filling.add(points, _SIZE * cells.size * depths / camera.fx, colors[rows])


def _spread(views: Sequence[View], most: int) -> list[View]:
    """Return at most `most` views at even intervals."""
    if len(views) <= most:
        return list(views)
    return [views[row] for row in np.linspace(0, len(views) - 1, most).round().astype(int)]


def _spacings(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return [P] root mean square distances of points to their neighbours, as in 3DGS."""
    from scipy.spatial import cKDTree

    count = min(_NEAREST, len(points) - 1)
    if count < 1:
        return np.zeros(len(points))
    distances, _ = cKDTree(points).query(points, k=count + 1)
    return np.asarray(np.sqrt((distances[:, 1:] ** 2).mean(axis=1)))


def _behind(
    view: View, pixels: NDArray[np.float64], depths: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return [N, 3] points at depths [N] on the rays through pixels [N, 2], in the local frame."""
    camera, pose = view.camera, view.camera.world_to_camera.numpy()
    rays = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    local = np.column_stack([rays, np.ones(len(rays))]) * depths[:, None]
    return np.asarray((local - pose[:3, 3]) @ pose[:3, :3])


@dataclass(frozen=True, eq=False)
class _Air:
    """The empty space around cameras: a ball up to the nearest point that each camera sees.

    Attributes:
        centers: [K, 3] centres of the cameras.
        reach: [K] radius of each ball: the depth of the nearest point that the camera sees.
    """

    centers: NDArray[np.float64]
    reach: NDArray[np.float64]

    @classmethod
    def of(cls, with_depth: Sequence[tuple[View, Depth]]) -> "_Air":
        centers = [view.camera.center.numpy() for view, _ in with_depth]
        reach = [1.0 / depth.nearest for _, depth in with_depth]
        return cls(np.array(centers).reshape(-1, 3), np.array(reach))

    def holds(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return [N], True if a point [N, 3] is in one of the balls.

        Points on the surface of a ball, up to rounding errors, do not count as inside.
        """
        held = np.zeros(len(points), dtype=np.bool_)
        for center, reach in zip(self.centers, self.reach, strict=True):
            held |= np.linalg.norm(points - center, axis=1) < 0.999 * reach
        return held


@dataclass(frozen=True, eq=False)
class _Pictures:
    """The volumes of space that views show, up to the depth of each view.

    Attributes:
        cameras: Cameras of the views.
        depths: Depth of each view; None if it is unknown, and then the view has no far limit.
        matrices: [V, 3, 4] projections from homogeneous points of the local frame to pixels times
            depth.
        ends: [V, 1, 2] width and height of the image.
        limits: [V, 2] depth up to which a view shows every point, and depth beyond which it shows
            no point.
    """

    cameras: Sequence[Camera]
    depths: Sequence[Depth | None]
    matrices: NDArray[np.float64]
    ends: NDArray[np.float64]
    limits: NDArray[np.float64]

    @classmethod
    def of(cls, depths: Mapping[View, Depth | None]) -> "_Pictures":
        cameras = [view.camera for view in depths]
        endless = (np.inf, np.inf)
        limits = [
            endless if deep is None else (_BEHIND / deep.nearest, _BEHIND * deep.sky)
            for deep in depths.values()
        ]
        return cls(
            cameras,
            list(depths.values()),
            np.stack([(camera.matrix @ camera.world_to_camera[:3]).numpy() for camera in cameras]),
            np.array([[[camera.width, camera.height]] for camera in cameras]),
            np.array(limits),
        )

    def show(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return [N], True if at least one view shows a point [N, 3].

        A view shows a point inside its image if the point's depth is at most `_BEHIND` times the
        view's depth at that pixel.
        """
        pixels, depth, inside = self._seen(points)
        shown = np.asarray((inside & (depth <= self.limits[:, :1])).any(axis=0))
        open_yet = inside & (depth <= self.limits[:, 1:])
        for view in map(int, np.flatnonzero((open_yet & ~shown).any(axis=1))):
            rows, deep = np.flatnonzero(open_yet[view] & ~shown), self.depths[view]
            if deep is not None:
                way = depth[view, rows]
                shown[rows] = way <= _BEHIND * self._at(view, pixels[view, rows] / way[:, None])
        return shown

    def look_down_on(
        self, points: NDArray[np.float64], up: NDArray[np.float64]
    ) -> NDArray[np.bool_]:
        """Return [N], True if a view from above shows the ground just below a point.

        Args:
            points: [N, 3] positions, local frame.
            up: [3] the scene's upward axis.
        """
        pixels, depth, inside = self._seen(points)
        low = np.zeros(len(points), dtype=np.bool_)
        for view in map(int, np.flatnonzero(inside.any(axis=1))):
            rays = points - self.cameras[view].center.numpy()
            steep = -(rays @ up) >= _STEEP * np.linalg.norm(rays, axis=1)
            rows = np.flatnonzero(inside[view] & steep & ~low)
            if self.depths[view] is not None and len(rows):
                way = depth[view, rows]
                share = way / self._at(view, pixels[view, rows] / way[:, None])
                low[rows] = (share >= _GROUND) & (share <= _BEHIND)
        return low

    def _seen(
        self, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
        """Return [V, N, 2] pixels times depth, [V, N] depths, and [V, N] True if in the image."""
        homogeneous = np.column_stack([points, np.ones(len(points))])
        around = np.einsum("vij,nj->vni", self.matrices, homogeneous)
        pixels, depth = around[..., :2], around[..., 2]
        # Compare pixels times depth instead of pixels, so that no division by a depth of zero
        # occurs.
        inside = ((pixels >= 0.0) & (pixels <= self.ends * depth[..., None])).all(axis=2)
        return pixels, depth, np.asarray(inside & (depth > 0.0))

    def _at(self, view: int, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return [N] depths at pixels [N, 2] of a view whose depth is known."""
        deep = self.depths[view]
        assert deep is not None
        return deep.at(from_the_middle(self.cameras[view], pixels))

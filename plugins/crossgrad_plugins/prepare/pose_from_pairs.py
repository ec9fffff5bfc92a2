"""Where the verified pairs of a photo say that it is, by rays and epipolar lines.

All pairs of a photo with photos that have poses are asked. The relative pose of a pair is a
direction to go from the other photo; it becomes a place where the direction of a second pair
crosses it, and where the points that the other photo shows tell how far to go. Of these places that
is the best which most matches agree with, whole pairs at a time. Source: Hartley and Zisserman,
Multiple View Geometry, 9.6, for the relative pose; the rest is ours.
"""

import itertools
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pycolmap


#: Pairs count from so many verified matches on; a pair agrees with two poses where this share of
#: its matches lies within so many pixels of the epipolar lines: more than in verification, because
#: a place is not exact before it is adjusted.
_MATCHES, _AGREEING, _PIXELS = 15, 0.5, 6.0
#: Pairs and agreeing matches that a place needs: one or the other.
_NEEDED: Final = ((3, 60), (2, 100))
#: Of a photo so many pairs, those with most matches, are asked for places.
_ASKED: Final = 16
#: Points that tell how far to go, at least, and the quantiles of the distances that are tried.
_POINTS, _QUANTILES = 4, (0.35, 0.5, 0.65)
#: Two directions cross where rotations differ by less, and directions by more, than these (cosines
#: of 5 and 2 degrees).
_SAME_ROTATION, _SAME_DIRECTION = 0.9962, 0.9994


@dataclass(frozen=True, order=True)
class Support:
    """Evidence for a place: agreeing matches, and the pairs that they are of."""

    matches: int = 0
    pairs: int = 0

    @property
    def enough(self) -> bool:
        """Whether a photo may stand there."""
        return any(self.pairs >= pairs and self.matches >= least for pairs, least in _NEEDED)


@dataclass(frozen=True, eq=False)
class PairView:
    """A pair of a photo with another one that has a pose.

    Attributes:
        other: Number of the other photo.
        pose: Its pose, world to camera.
        focals: Of the other one and of the photo, pixels.
        rays: [N, 2] matches in the other one and in the photo, in units of the focal length.
        features: [N] which features of the other one they are.
    """

    other: int
    pose: "pycolmap.Rigid3d"
    focals: tuple[float, float]
    rays: tuple[NDArray[np.float32], NDArray[np.float32]]
    features: NDArray[np.int64]

    def agreeing(self, pose: "pycolmap.Rigid3d") -> int:
        """How many matches agree with a pose of the photo; 0 where too few of the pair do."""
        near = int((off_lines((self.pose, pose), self.rays, self.focals) <= _PIXELS).sum())
        return near if near >= _AGREEING * len(self.features) else 0

    def relative(self) -> "pycolmap.Rigid3d | None":
        """The photo's pose relative to the other one, its translation of any length."""
        import pycolmap

        options = pycolmap.TwoViewGeometryOptions()
        options.compute_relative_pose, options.ransac.random_seed = True, 0
        # Verification has looked for them; these cameras have no borders.
        options.detect_watermark = False
        cameras = [
            pycolmap.Camera(model="SIMPLE_PINHOLE", width=1, height=1, params=[focal, 0, 0])
            for focal in self.focals
        ]
        points = [
            np.asarray(rays, dtype=np.float64) * focal
            for rays, focal in zip(self.rays, self.focals, strict=True)
        ]
        found = pycolmap.estimate_calibrated_two_view_geometry(
            cameras[0], points[0], cameras[1], points[1],
            np.repeat(np.arange(len(points[0]), dtype=np.uint32)[:, None], 2, axis=1), options,
        )  # fmt: skip
        enough = len(np.asarray(found.inlier_matches)) >= _MATCHES
        return found.cam2_from_cam1 if enough else None


class Pairs:
    """All verified pairs of a database, as cameras see them.

    Args:
        cameras: By number; those of the database where one is missing.
        database: COLMAP's database, open.
    """

    def __init__(
        self, cameras: "Mapping[int, pycolmap.Camera]", database: "pycolmap.Database"
    ) -> None:
        import pycolmap

        self.rays = Rays(cameras, database)
        self.matches: dict[tuple[int, int], NDArray[np.int64]] = {}
        self.partners: dict[int, list[int]] = {}
        pairs, counts = database.read_two_view_geometry_num_inliers()
        for pair, count in zip(pairs, counts, strict=True):
            if count >= _MATCHES:
                one, two = pycolmap.pair_id_to_image_pair(pair)
                found = np.asarray(database.read_two_view_geometry(one, two).inlier_matches)
                self.matches[one, two] = found.astype(np.int64)
                self.partners.setdefault(one, []).append(two)
                self.partners.setdefault(two, []).append(one)

    def sights(self, photo: int, poses: "Mapping[int, pycolmap.Rigid3d]") -> list[PairView]:
        """The pairs of a photo with those that have poses, that with most matches first."""
        found = []
        for other in self.partners.get(photo, ()):
            if other in poses:
                stored = self.matches.get((other, photo))
                rows = self.matches[photo, other][:, ::-1] if stored is None else stored
                rays = self.rays.of(other)[rows[:, 0]], self.rays.of(photo)[rows[:, 1]]
                focals = self.rays.focal(other), self.rays.focal(photo)
                found.append(PairView(other, poses[other], focals, rays, rows[:, 0]))
        return sorted(found, key=lambda sight: (-len(sight.features), sight.other))

    def without(self, aside: Collection[tuple[int, int]]) -> frozenset[int]:
        """The photos that have no pair beside these."""
        left = {photo for pair in self.matches if pair not in aside for photo in pair}
        return frozenset(self.partners.keys() - left)

    def contradicting(self, poses: "Mapping[int, pycolmap.Rigid3d]") -> frozenset[tuple[int, int]]:
        """The pairs of photos with poses that do not agree with these."""
        return frozenset(
            (sight.other, photo)
            for photo in poses
            for sight in self.sights(photo, poses)
            if (sight.other, photo) in self.matches and not sight.agreeing(poses[photo])
        )


def support(sights: Sequence[PairView], pose: "pycolmap.Rigid3d") -> Support:
    """What speaks for a pose."""
    agreeing = [count for sight in sights if (count := sight.agreeing(pose))]
    return Support(sum(agreeing), len(agreeing))


def best_place(
    model: "pycolmap.Reconstruction", sights: Sequence[PairView]
) -> "tuple[Support, pycolmap.Rigid3d | None]":
    """The place that most pairs agree with; no pose where no pair tells any."""
    most, best = Support(), None
    for pose in _places(model, sights[:_ASKED]):
        this = support(sights, pose)
        if this > most:
            most, best = this, pose
    return most, best


def _places(
    model: "pycolmap.Reconstruction", sights: Sequence[PairView]
) -> "Iterator[pycolmap.Rigid3d]":
    ways = [way for sight in sights if (way := _way(model, sight)) is not None]
    for way in ways:
        if len(way.distances) >= _POINTS:
            for share in _QUANTILES:
                yield way.to(float(np.quantile(way.distances, share)))
    for one, two in itertools.permutations(ways, 2):
        if (crossing := one.crossing(two)) is not None:
            yield one.to(crossing)


@dataclass(frozen=True, eq=False)
class _Way:
    """Where a pair says that a photo is.

    Attributes:
        rotation: [3, 3] world to the photo.
        start: [3] the centre of the other photo.
        direction: [3] from there to the photo, of length 1.
        distances: How far to go by points that the other photo shows.
    """

    rotation: NDArray[np.float64]
    start: NDArray[np.float64]
    direction: NDArray[np.float64]
    distances: NDArray[np.float64]

    def to(self, distance: float) -> "pycolmap.Rigid3d":
        """The pose at that distance."""
        import pycolmap

        center = self.start + distance * self.direction
        return pycolmap.Rigid3d(pycolmap.Rotation3d(self.rotation), -self.rotation @ center)

    def crossing(self, other: "_Way") -> float | None:
        """The distance at which it comes nearest to another way; None where they do not meet."""
        turned = (np.trace(self.rotation @ other.rotation.T) - 1.0) / 2.0
        along = float(self.direction @ other.direction)
        if turned < _SAME_ROTATION or abs(along) > _SAME_DIRECTION:
            return None
        between = other.start - self.start
        here, there = float(between @ self.direction), float(between @ other.direction)
        mine = (here - along * there) / (1.0 - along**2)
        theirs = (along * here - there) / (1.0 - along**2)
        return mine if mine > 0.0 and theirs > 0.0 else None


def _way(model: "pycolmap.Reconstruction", sight: PairView) -> _Way | None:
    relative = sight.relative()
    if relative is None:
        return None
    pose = relative * sight.pose
    rotation, start = pose.rotation.matrix(), sight.pose.inverse().translation
    turned = -rotation.T @ relative.translation
    length = float(np.linalg.norm(turned))
    if length == 0.0:
        return None
    direction = turned / length
    return _Way(rotation, start, direction, _distances(model, sight, rotation, direction))


def _distances(
    model: "pycolmap.Reconstruction",
    sight: PairView,
    rotation: NDArray[np.float64],
    direction: NDArray[np.float64],
) -> NDArray[np.float64]:
    """[M] how far along the direction the photo sees each point of the other one where it is."""
    points = model.image(sight.other).points2D
    rows = [row for row, at in enumerate(sight.features) if points[int(at)].has_point3D()]
    if not rows:
        return np.zeros(0)
    places = [model.point3D(points[int(sight.features[row])].point3D_id).xyz for row in rows]
    offsets = np.stack(places) - sight.pose.inverse().translation
    rays = np.column_stack([sight.rays[1][rows], np.ones(len(rows))]) @ rotation
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    # Beside the ray to a point, what is left of its offset and of the direction is parallel.
    across = direction - rays * (rays @ direction)[:, None]
    beside = offsets - rays * (rays * offsets).sum(axis=1, keepdims=True)
    square = (across**2).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        found = (across * beside).sum(axis=1) / square
    ahead = ((offsets - found[:, None] * direction) * rays).sum(axis=1) > 0.0
    return np.asarray(found[(square > 1.0 - _SAME_DIRECTION**2) & (found > 0.0) & ahead])


class Rays:
    """Features of photos without lens distortion, read when they are asked for, and kept.

    Args:
        cameras: By number; those of the database where one is missing.
        database: COLMAP's database, open.
    """

    def __init__(
        self, cameras: "Mapping[int, pycolmap.Camera]", database: "pycolmap.Database"
    ) -> None:
        self._given, self._database = cameras, database
        self._cameras: dict[int, pycolmap.Camera] = {}
        self._rays: dict[int, NDArray[np.float32]] = {}

    def camera(self, number: int) -> "pycolmap.Camera":
        """The camera of a photo."""
        if number not in self._cameras:
            camera = self._database.read_image(number).camera_id
            self._cameras[number] = (
                self._given[camera] if camera in self._given else self._database.read_camera(camera)
            )
        return self._cameras[number]

    def focal(self, number: int) -> float:
        """The focal length of a photo, pixels."""
        return float(self.camera(number).mean_focal_length())

    def of(self, number: int) -> NDArray[np.float32]:
        """[N, 2] features of a photo in units of the focal length."""
        if number not in self._rays:
            pixels = np.asarray(self._database.read_keypoints(number)[:, :2], dtype=np.float64)
            rays = self.camera(number).cam_from_img(pixels)
            self._rays[number] = np.asarray(rays, dtype=np.float32)
        return self._rays[number]


def off_lines(
    poses: "tuple[pycolmap.Rigid3d, pycolmap.Rigid3d]",
    rays: tuple[NDArray[np.float32], NDArray[np.float32]],
    focals: tuple[float, float],
) -> NDArray[np.float64]:
    """[N] pixels that matches lie from each other's epipolar lines, the larger of both.

    Args:
        poses: Of two photos, world to camera.
        rays: [N, 2] matches in each, in units of the focal length.
        focals: Of each, pixels.
    """
    relative = poses[1] * poses[0].inverse()
    x, y, z = relative.translation
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    essential = cross @ relative.rotation.matrix()
    here, there = (np.column_stack([points, np.ones(len(points))]) for points in rays)
    lines, back = here @ essential.T, there @ essential
    error = np.abs((there * lines).sum(axis=1))
    # Two photos of one place have no epipolar lines, and nothing to contradict.
    tiny = np.finfo(np.float64).tiny
    in_other = error / np.maximum(tiny, np.hypot(lines[:, 0], lines[:, 1])) * focals[1]
    in_one = error / np.maximum(tiny, np.hypot(back[:, 0], back[:, 1])) * focals[0]
    return np.asarray(np.maximum(in_one, in_other))

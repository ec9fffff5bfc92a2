"""Pose of a photo from its verified pairs, by rays and epipolar lines.

All pairs with photos whose poses are known are used. The relative pose of a pair gives the rotation
of the photo, and the direction from the other photo to it. The distance between the photos follows
from the direction of a second pair, or from points that the other photo shows. Each possible
distance gives one candidate pose. The candidate with the most agreeing matches is chosen. A pair
counts only if enough of its matches agree with the pose. Source: Hartley and Zisserman, Multiple
View Geometry, 9.6, for the relative pose. The other steps were developed for crossgrad.
"""

import itertools
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pycolmap


#: Minimum number of verified matches of a pair, minimum share of the matches that must agree with
#: two poses, and maximum distance in pixels from an agreeing match to its epipolar line. The
#: distance is larger than in COLMAP's verification, because a pose is inexact before bundle
#: adjustment.
_MATCHES, _AGREEING, _PIXELS = 15, 0.5, 6.0
#: A pose needs a minimum number of pairs together with a minimum number of agreeing matches. One of
#: these two combinations is sufficient.
_NEEDED: Final = ((3, 60), (2, 100))
#: Number of a photo's pairs from which candidate poses are computed. The pairs with the most
#: matches are chosen.
_ASKED: Final = 16
#: Minimum number of points that determine a distance, and the quantiles of the distances that
#: become candidates.
_POINTS, _QUANTILES = 4, (0.35, 0.5, 0.65)
#: Two directions are intersected if their rotations differ by at most 5 degrees and if the
#: directions differ by at least 2 degrees. The values are the cosines of these angles.
_SAME_ROTATION, _SAME_DIRECTION = 0.9962, 0.9994


@dataclass(frozen=True, order=True)
class Support:
    """Evidence for a pose: number of agreeing matches, and number of pairs that contain them."""

    matches: int = 0
    pairs: int = 0

    @property
    def enough(self) -> bool:
        """True if the evidence is sufficient for a pose."""
        return any(self.pairs >= pairs and self.matches >= least for pairs, least in _NEEDED)


@dataclass(frozen=True, eq=False)
class PairView:
    """A pair of a photo with another photo whose pose is known.

    Attributes:
        other: Number of the other photo.
        pose: Pose of the other photo, world to camera.
        focals: Focal length of the other photo and of this photo, in pixels.
        rays: [N, 2] matches in the other photo and in this photo, divided by the focal length.
        features: [N] indices of the matched features in the other photo.
    """

    other: int
    pose: "pycolmap.Rigid3d"
    focals: tuple[float, float]
    rays: tuple[NDArray[np.float32], NDArray[np.float32]]
    features: NDArray[np.int64]

    def agreeing(self, pose: "pycolmap.Rigid3d") -> int:
        """Return the number of matches that agree with a pose; 0 if too few agree."""
        near = int((off_lines((self.pose, pose), self.rays, self.focals) <= _PIXELS).sum())
        return near if near >= _AGREEING * len(self.features) else 0

    def relative(self) -> "pycolmap.Rigid3d | None":
        """Return the pose relative to the other photo; the length of the translation is unknown."""
        import pycolmap

        options = pycolmap.TwoViewGeometryOptions()
        options.compute_relative_pose, options.ransac.random_seed = True, 0
        # Do not search for watermarks again, because verification has removed such matches.
        options.detect_watermark = False
        cameras = [
            pycolmap.Camera(model="SIMPLE_PINHOLE", width=1, height=1, params=[focal, 0, 0])
            for focal in self.focals
        ]
        points = [
            np.asarray(rays, dtype=np.float64) * focal
            for rays, focal in zip(self.rays, self.focals, strict=True)
        ]
        geometry = pycolmap.estimate_calibrated_two_view_geometry(
            cameras[0], points[0], cameras[1], points[1],
            np.repeat(np.arange(len(points[0]), dtype=np.uint32)[:, None], 2, axis=1), options,
        )  # fmt: skip
        enough = len(np.asarray(geometry.inlier_matches)) >= _MATCHES
        return geometry.cam2_from_cam1 if enough else None


class Pairs:
    """All verified pairs of a database, as rays of the cameras.

    Args:
        cameras: Known cameras by number. Other cameras are read from the database.
        database: COLMAP's database, already open.
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
                inliers = np.asarray(database.read_two_view_geometry(one, two).inlier_matches)
                self.matches[one, two] = inliers.astype(np.int64)
                self.partners.setdefault(one, []).append(two)
                self.partners.setdefault(two, []).append(one)

    def sights(self, photo: int, poses: "Mapping[int, pycolmap.Rigid3d]") -> list[PairView]:
        """Return the pairs of a photo with photos of known pose, most matches first."""
        sights = []
        for other in self.partners.get(photo, ()):
            if other in poses:
                stored = self.matches.get((other, photo))
                rows = self.matches[photo, other][:, ::-1] if stored is None else stored
                rays = self.rays.of(other)[rows[:, 0]], self.rays.of(photo)[rows[:, 1]]
                focals = self.rays.focal(other), self.rays.focal(photo)
                sights.append(PairView(other, poses[other], focals, rays, rows[:, 0]))
        return sorted(sights, key=lambda sight: (-len(sight.features), sight.other))

    def without(self, aside: Collection[tuple[int, int]]) -> frozenset[int]:
        """Return the photos all of whose pairs are in `aside`."""
        left = {photo for pair in self.matches if pair not in aside for photo in pair}
        return frozenset(self.partners.keys() - left)

    def contradicting(self, poses: "Mapping[int, pycolmap.Rigid3d]") -> frozenset[tuple[int, int]]:
        """Return the pairs of photos with poses whose matches contradict these poses."""
        return frozenset(
            (sight.other, photo)
            for photo in poses
            for sight in self.sights(photo, poses)
            if (sight.other, photo) in self.matches and not sight.agreeing(poses[photo])
        )


def support(sights: Sequence[PairView], pose: "pycolmap.Rigid3d") -> Support:
    """Return the evidence of all pairs for a pose."""
    agreeing = [count for sight in sights if (count := sight.agreeing(pose))]
    return Support(sum(agreeing), len(agreeing))


def best_place(
    model: "pycolmap.Reconstruction", sights: Sequence[PairView]
) -> "tuple[Support, pycolmap.Rigid3d | None]":
    """Return the pose with the most evidence, and this evidence.

    The pose is None if no pose has evidence.
    """
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
    """A half-line that, according to one pair, contains the centre of a photo.

    Attributes:
        rotation: [3, 3] rotation from the world to the photo.
        start: [3] centre of the other photo, where the half-line starts.
        direction: [3] unit direction from the other photo to the photo.
        distances: Possible distances along the half-line, from points that the other photo shows.
    """

    rotation: NDArray[np.float64]
    start: NDArray[np.float64]
    direction: NDArray[np.float64]
    distances: NDArray[np.float64]

    def to(self, distance: float) -> "pycolmap.Rigid3d":
        """Return the pose at a distance along the half-line."""
        import pycolmap

        center = self.start + distance * self.direction
        return pycolmap.Rigid3d(pycolmap.Rotation3d(self.rotation), -self.rotation @ center)

    def crossing(self, other: "_Way") -> float | None:
        """Return the distance at which another half-line crosses this one.

        The result is None if the half-lines do not cross.
        """
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
    """Return the distances [M] at which the photo's rays meet points of the other photo."""
    points = model.image(sight.other).points2D
    rows = [row for row, at in enumerate(sight.features) if points[int(at)].has_point3D()]
    if not rows:
        return np.zeros(0)
    positions = [model.point3D(points[int(sight.features[row])].point3D_id).xyz for row in rows]
    offsets = np.stack(positions) - sight.pose.inverse().translation
    rays = np.column_stack([sight.rays[1][rows], np.ones(len(rows))]) @ rotation
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    # Project everything onto the plane perpendicular to the ray to a point; there, offset and
    # direction are parallel at the correct distance.
    across = direction - rays * (rays @ direction)[:, None]
    beside = offsets - rays * (rays * offsets).sum(axis=1, keepdims=True)
    square = (across**2).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        distances = (across * beside).sum(axis=1) / square
    ahead = ((offsets - distances[:, None] * direction) * rays).sum(axis=1) > 0.0
    return np.asarray(distances[(square > 1.0 - _SAME_DIRECTION**2) & (distances > 0.0) & ahead])


class Rays:
    """Features of photos without lens distortion.

    They are read when they are needed, and cached.

    Args:
        cameras: Known cameras by number. Other cameras are read from the database.
        database: COLMAP's database, already open.
    """

    def __init__(
        self, cameras: "Mapping[int, pycolmap.Camera]", database: "pycolmap.Database"
    ) -> None:
        self._given, self._database = cameras, database
        self._cameras: dict[int, pycolmap.Camera] = {}
        self._rays: dict[int, NDArray[np.float32]] = {}

    def camera(self, number: int) -> "pycolmap.Camera":
        """Return the camera of a photo."""
        if number not in self._cameras:
            camera = self._database.read_image(number).camera_id
            self._cameras[number] = (
                self._given[camera] if camera in self._given else self._database.read_camera(camera)
            )
        return self._cameras[number]

    def focal(self, number: int) -> float:
        """Return the focal length of a photo, in pixels."""
        return float(self.camera(number).mean_focal_length())

    def of(self, number: int) -> NDArray[np.float32]:
        """Return the features [N, 2] of a photo, divided by the focal length."""
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
    """Return the distances [N] of matches to their epipolar lines, in pixels.

    Of the distances in the two photos, the larger one is returned.

    Args:
        poses: Poses of two photos, world to camera.
        rays: [N, 2] matches in each photo, divided by the focal length.
        focals: Focal length of each photo, in pixels.
    """
    relative = poses[1] * poses[0].inverse()
    x, y, z = relative.translation
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    essential = cross @ relative.rotation.matrix()
    here, there = (np.column_stack([points, np.ones(len(points))]) for points in rays)
    lines, back = here @ essential.T, there @ essential
    error = np.abs((there * lines).sum(axis=1))
    # Two photos with one centre have no epipolar lines, so their matches cannot contradict the
    # poses.
    tiny = np.finfo(np.float64).tiny
    in_other = error / np.maximum(tiny, np.hypot(lines[:, 0], lines[:, 1])) * focals[1]
    in_one = error / np.maximum(tiny, np.hypot(back[:, 0], back[:, 1])) * focals[0]
    return np.asarray(np.maximum(in_one, in_other))

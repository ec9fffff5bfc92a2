"""Points for scenes without SfM points: features of photos are matched and triangulated."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import starmap
from typing import ClassVar, Final
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from typing_extensions import override

from crossgrad_core.plugin import (
    Camera,
    Initializer,
    MorePoints,
    Scene,
    UserError,
    View,
    centers_of,
)
from crossgrad_core.scene.pycolmap_guard import guard_pycolmap

#: Cosine of the largest angle between the axes of two cameras whose photos are matched.
_ASKEW: Final = 0.5
_FEWEST: Final = 3
# Weights of red, green and blue for grey images (ITU-R BT.601).
_GREY: Final = np.array([0.299, 0.587, 0.114])
#: Cache of the triangulated points of each scene and initializer. An entry is deleted together with
#: its scene.
_KNOWN: "WeakKeyDictionary[Scene, dict[Triangulated, MorePoints]]" = WeakKeyDictionary()
#: Lowe's ratio: the distance to the nearest descriptor divided by the distance to the second
#: nearest (SIFT, section 7.1).
_RATIO: Final = 0.8
#: Smallest and largest angle between the two rays of a match. At smaller angles, the intersection
#: of the rays is inaccurate. At larger angles, the two features usually show different surfaces.
_SMALLEST, _LARGEST = np.deg2rad(1.5), np.deg2rad(60.0)


@dataclass(frozen=True, eq=False)
class Features:
    """Features of a photo.

    Attributes:
        camera: The photo's camera.
        pixels: [F, 2] positions; the centre of a pixel is at +0.5.
        descriptors: [F, D] float32 descriptors of length 1.
        colors: [F, 3] uint8 colours of the photo at the features.
    """

    camera: Camera
    pixels: NDArray[np.float64]
    descriptors: NDArray[np.float32]
    colors: NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Met:
    """Matched features of two photos and their triangulated points.

    Attributes:
        first: [M] indices of the features of the first photo.
        second: [M] indices of the features of the second photo.
        points: [M, 3] triangulated points, local frame.
        angles: [M] angles between the two rays at each point, radians.
    """

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    points: NDArray[np.float64]
    angles: NDArray[np.float64]


class Triangulated(Initializer):
    """Triangulates SIFT features of neighbouring training photos if a scene has no points.

    The poses of the cameras are not changed. This initializer adds no points to a scene that has
    points.
    """

    alone: ClassVar[bool] = True

    views: int = Field(200, ge=2, description="maximum number of photos to match")
    neighbours: int = Field(
        4, ge=1, le=50, description="number of photos that each photo is matched with"
    )
    features: int = Field(
        2048, ge=16, le=65_536, description="maximum number of features per photo"
    )
    pixels: float = Field(2.0, gt=0.0, description="maximum reprojection error of a point")

    @override
    def more_points(self, scene: Scene) -> MorePoints | None:
        if len(scene.points):
            return None
        cached = _KNOWN.setdefault(scene, {})
        if self not in cached:
            cached[self] = self._found(scene)
        return cached[self]

    @override
    def messages(self, scene: Scene) -> tuple[str, ...]:
        more = self.more_points(scene)
        if more is None:
            return ("start: the scene has points, so none are triangulated",)
        return (f"start: {len(more.positions)} points triangulated from pairs of photos",)

    def _found(self, scene: Scene) -> MorePoints:
        views = _spread(scene.train_views, self.views)
        features = [self._features(view) for view in views]
        pairs = _pairs(views, self.neighbours)
        met = list(starmap(self._meet, ((features[i], features[j]) for i, j in pairs)))
        kept = _best(pairs, met)
        if len(kept) < _FEWEST:
            raise UserError(
                "no points could be triangulated from the photos",
                where=scene.name,
                expected=f"at least {_FEWEST} points, each visible in two photos",
                found=f"{len(kept)} in {len(pairs)} pairs of photos",
                todo="check that the poses belong to the photos, or start from the points of a "
                "file (--points FILE) or from random points (--init random)",
            )
        unknown = np.full(len(kept), np.nan)
        colors = [features[pairs[p][0]].colors[met[p].first[m]] for p, m in kept]
        return MorePoints(
            positions=np.array([met[p].points[m] for p, m in kept]),
            colors=np.array(colors),
            sizes=unknown,
            opacities=unknown,
        )

    def _meet(self, first: Features, second: Features) -> Met:
        return meet(first, second, self.pixels)

    def _features(self, view: View) -> Features:
        """Return the SIFT features of a photo at unmasked pixels."""
        photo = view.photo
        image, mask = photo.image().cpu().numpy(), photo.mask()
        grey = np.ascontiguousarray((image @ _GREY).round().astype(np.uint8))
        pixels, descriptors = _sift(grey, self.features)
        across, down = np.floor(pixels).astype(np.int64).clip(0, np.array(grey.shape[::-1]) - 1).T
        counts = np.ones(grey.shape, np.bool_) if mask is None else mask.cpu().numpy()
        rows = np.flatnonzero(counts[down, across])
        lengths = np.linalg.norm(descriptors[rows], axis=1, keepdims=True)
        colors = image[down[rows], across[rows]]
        return Features(
            view.camera, pixels[rows], descriptors[rows] / np.maximum(lengths, 1.0), colors
        )


def _sift(grey: NDArray[np.uint8], most: int) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Return pixels [F, 2] and descriptors [F, 128] of length 512 for a grey photo [H, W]."""
    guard_pycolmap()
    import pycolmap

    options = pycolmap.FeatureExtractionOptions()
    options.sift.max_num_features = most
    options.num_threads = 1
    before, pycolmap.logging.minloglevel = pycolmap.logging.minloglevel, 1
    try:
        extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
        keypoints, descriptors = extractor.extract_from_uint8_array(grey)
    finally:
        pycolmap.logging.minloglevel = before
    pixels = np.array([(point.x, point.y) for point in keypoints], dtype=np.float64)
    return pixels.reshape(-1, 2), np.array(descriptors.data, dtype=np.float32).reshape(-1, 128)


def _spread(views: Sequence[View], most: int) -> list[View]:
    """Return at most `most` views at even intervals."""
    if len(views) <= most:
        return list(views)
    return [views[row] for row in np.linspace(0, len(views) - 1, most).round().astype(int)]


def _pairs(views: Sequence[View], neighbours: int) -> list[tuple[int, int]]:
    """Return the pairs of photos to match.

    Each photo is paired with the photos of the nearest cameras that look in a similar direction.
    """
    centers = centers_of(views)
    axes = np.stack([view.camera.world_to_camera[2, :3].numpy() for view in views])
    pairs: set[tuple[int, int]] = set()
    for i in range(len(views)):
        distances = np.linalg.norm(centers - centers[i], axis=1)
        # Two cameras at the same position cannot determine a depth.
        distances[(axes @ axes[i] < _ASKEW) | (distances == 0.0)] = np.inf
        near = np.argsort(distances, kind="stable")[:neighbours]
        pairs |= {(min(i, j), max(i, j)) for j in near.tolist() if np.isfinite(distances[j])}
    return sorted(pairs)


def _best(pairs: Sequence[tuple[int, int]], met: Sequence[Met]) -> list[tuple[int, int]]:
    """Return the pair and the row of each match to keep.

    A feature may have matches in several pairs; only its match with the widest angle is kept.
    """
    angles = np.concatenate([common.angles for common in met]) if met else np.zeros(0)
    matches = [(p, m) for p, common in enumerate(met) for m in range(len(common.points))]
    used: set[tuple[int, int]] = set()
    kept = []
    for index in np.argsort(-angles, kind="stable").tolist():
        p, m = matches[index]
        ends = {(pairs[p][0], int(met[p].first[m])), (pairs[p][1], int(met[p].second[m]))}
        if not ends & used:
            used |= ends
            kept.append((p, m))
    return sorted(kept)


def meet(first: Features, second: Features, pixels: float) -> Met:
    """Return the matched features of two photos, and their triangulated points.

    Two features match if each descriptor is the nearest to the other by a clear margin. A point is
    kept if it is in front of both cameras. In both photos, its projection must also be at most
    `pixels` from the feature.
    """
    one, other = _matched(first.descriptors, second.descriptors)
    at = first.pixels[one], second.pixels[other]
    points = _triangulated(_projection(first.camera), _projection(second.camera), *at)
    good = np.isfinite(points).all(axis=1)
    for features, measured in zip((first, second), at, strict=True):
        shown, depth = features.camera.project(points)
        good &= (depth > 0.0) & (np.linalg.norm(shown - measured, axis=1) <= pixels)
    angles = _angles(first.camera, second.camera, points)
    good &= (angles >= _SMALLEST) & (angles <= _LARGEST)
    return Met(one[good], other[good], points[good], angles[good])


def _matched(
    first: NDArray[np.float32], second: NDArray[np.float32]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the rows of matching descriptors in the first and in the second photo.

    Two descriptors match if each is the nearest to the other, and clearly nearer than the
    second-nearest.
    """
    nothing = np.zeros(0, dtype=np.int64)
    if min(len(first), len(second)) <= 1:
        return nothing, nothing
    alike = first @ second.T
    nearest = alike.argmax(axis=1)
    rows = np.arange(len(first))
    best = alike[rows, nearest]
    alike[rows, nearest] = -1.0
    rival = alike.max(axis=1)
    alike[rows, nearest] = best
    # Descriptors have length 1, so their squared distance is 2 - 2 cos.
    clear = (1.0 - best) < _RATIO**2 * (1.0 - rival)
    mutual = alike.argmax(axis=0)[nearest] == rows
    chosen = np.flatnonzero(clear & mutual)
    return chosen, nearest[chosen].astype(np.int64)


def _projection(camera: Camera) -> NDArray[np.float64]:
    """Return [3, 4] the projection of homogeneous local points to homogeneous pixels."""
    return np.asarray((camera.matrix @ camera.world_to_camera[:3]).numpy())


def _triangulated(
    first: NDArray[np.float64],
    second: NDArray[np.float64],
    at: NDArray[np.float64],
    other: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return [M, 3] points triangulated linearly.

    The inputs are two projections [3, 4] and two sets of pixels [M, 2].

    Source: Hartley and Zisserman, Multiple View Geometry, section 12.2 (homogeneous method).
    """
    if not len(at):
        return np.zeros((0, 3))
    rows = [pixels[:, k, None] * matrix[2] - matrix[k]
            for matrix, pixels in ((first, at), (second, other)) for k in (0, 1)]  # fmt: skip
    system = np.stack(rows, axis=1)
    system /= np.linalg.norm(system, axis=2, keepdims=True)
    solution = np.linalg.svd(system)[2][:, -1]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(solution[:, :3] / solution[:, 3:])


def _angles(first: Camera, second: Camera, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return [M] angles between the rays from two cameras to points [M, 3]."""
    rays = [camera.center.numpy() - points for camera in (first, second)]
    with np.errstate(divide="ignore", invalid="ignore"):
        one, other = (ray / np.linalg.norm(ray, axis=1, keepdims=True) for ray in rays)
    return np.asarray(np.arccos(np.clip((one * other).sum(axis=1), -1.0, 1.0)))

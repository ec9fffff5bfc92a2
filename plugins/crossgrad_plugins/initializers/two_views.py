"""Points from two photos whose cameras are known: matched features, where their rays meet."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import Camera

#: Lowe's ratio of the nearest descriptor to the second (SIFT, section 7.1), as distances.
_RATIO: Final = 0.8
#: Rays that differ by less meet nowhere in particular; features seen under more are not the same.
_SMALLEST, _LARGEST = np.deg2rad(1.5), np.deg2rad(60.0)


@dataclass(frozen=True, eq=False)
class Features:
    """Features of a photo.

    Attributes:
        camera: The photo's camera.
        pixels: [F, 2] where they are, pixel centres at +0.5.
        descriptors: [F, D] float32, of length 1.
        colors: [F, 3] uint8 the photo's colours there.
    """

    camera: Camera
    pixels: NDArray[np.float64]
    descriptors: NDArray[np.float32]
    colors: NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Met:
    """Features of two photos whose rays meet.

    Attributes:
        first: [M] rows of the features of one photo.
        second: [M] of those of the other.
        points: [M, 3] where they meet, local frame.
        angles: [M] between the rays, radians.
    """

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    points: NDArray[np.float64]
    angles: NDArray[np.float64]


def meet(first: Features, second: Features, pixels: float) -> Met:
    """The features that two photos share, and the points that they show.

    Each is the other's nearest by far, both rays have it in front of the camera, and in both photos
    the point lies within so many pixels of its feature.
    """
    one, other = _matched(first.descriptors, second.descriptors)
    at = first.pixels[one], second.pixels[other]
    points = _triangulated(_projection(first.camera), _projection(second.camera), *at)
    good = np.isfinite(points).all(axis=1)
    for features, found in zip((first, second), at, strict=True):
        shown, depth = features.camera.project(points)
        good &= (depth > 0.0) & (np.linalg.norm(shown - found, axis=1) <= pixels)
    angles = _angles(first.camera, second.camera, points)
    good &= (angles >= _SMALLEST) & (angles <= _LARGEST)
    return Met(one[good], other[good], points[good], angles[good])


def _matched(
    first: NDArray[np.float32], second: NDArray[np.float32]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows of descriptors that are each other's nearest, and much nearer than the second."""
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
    # Descriptors have length 1: their squared distance is 2 - 2 cos.
    clear = (1.0 - best) < _RATIO**2 * (1.0 - rival)
    mutual = alike.argmax(axis=0)[nearest] == rows
    chosen = np.flatnonzero(clear & mutual)
    return chosen, nearest[chosen].astype(np.int64)


def _projection(camera: Camera) -> NDArray[np.float64]:
    """[3, 4] homogeneous points of the local frame to homogeneous pixels."""
    return np.asarray((camera.matrix @ camera.world_to_camera[:3]).numpy())


def _triangulated(
    first: NDArray[np.float64],
    second: NDArray[np.float64],
    at: NDArray[np.float64],
    other: NDArray[np.float64],
) -> NDArray[np.float64]:
    """[M, 3] points whose projections [3, 4] are nearest to pixels [M, 2], linearly.

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
    """[M] angles at points [M, 3] between the rays to two cameras."""
    rays = [each.center.numpy() - points for each in (first, second)]
    with np.errstate(divide="ignore", invalid="ignore"):
        one, other = (ray / np.linalg.norm(ray, axis=1, keepdims=True) for ray in rays)
    return np.asarray(np.arccos(np.clip((one * other).sum(axis=1), -1.0, 1.0)))

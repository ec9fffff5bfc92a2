"""The brightness of photos at the SfM points that they show."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_core.plugin import Camera, Scene, UserError, View
from crossgrad_plugins.exposures.srgb import decoded

#: Maximum number of observations. If a scene has more observations, only every n-th point is used.
_MOST = 400_000
#: Number of photos that are decoded at the same time. More photos would need too much memory.
_AT_ONCE = 2
#: Usable range of linear light in [0, 1]: lower values are noise, and higher values are clipped.
DARKEST, BRIGHTEST = 0.02, 0.98
_NEIGHBOURS = tuple((down, right) for down in (-1, 0, 1) for right in (-1, 0, 1))


@dataclass(frozen=True, eq=False)
class Observations:
    """Usable observations of points that at least two of the photos show.

    Attributes:
        photos: [O] index of each observation's photo among the given views.
        points: [O] number of each observation's point, counted from 0 without gaps.
        stops: [O] log2 of the brightness in linear light.
        rows: [N] index of each numbered point among the points of the scene.
    """

    photos: NDArray[np.int64]
    points: NDArray[np.int64]
    stops: NDArray[np.float64]
    rows: NDArray[np.int64]

    @property
    def count(self) -> int:
        """Number of observations."""
        return len(self.stops)


def observations_of(scene: Scene, views: Sequence[View]) -> Observations:
    """Measure the brightness of the scene's points in the photos of some views.

    A photo is sampled with 3 x 3 pixels at the projection of each point that it observed. Photos
    that observed no usable point are not decoded. A photo that cannot be decoded has no
    observations. The run reports the error when it uses the photo.
    """
    shared = _shared_points(scene, views)
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        observed = list(pool.map(lambda view: _observed(scene, view, shared), views))
    photos = np.repeat(np.arange(len(views)), [len(rows) for rows, _ in observed])
    rows = np.concatenate([np.zeros(0, dtype=np.int64), *(rows for rows, _ in observed)])
    stops = np.concatenate([np.zeros(0), *(stops for _, stops in observed)])
    # A point that is usable in only one photo gives no information about relative brightness.
    _, numbers, times = np.unique(rows, return_inverse=True, return_counts=True)
    kept = times[numbers] > 1
    usable_rows, numbers = np.unique(rows[kept], return_inverse=True)
    return Observations(photos[kept], numbers, stops[kept], usable_rows)


def _shared_points(scene: Scene, views: Sequence[View]) -> NDArray[np.bool_]:
    """Return [P], True for points whose brightness is measured.

    At least two views must show a point. If there are too many points, only every n-th point is
    used.
    """
    times = np.zeros(len(scene.points), dtype=np.int64)
    for view in views:
        times[view.seen] += 1
    shared = times > 1
    every = -(-int(times[shared].sum()) // _MOST)
    if every > 1:
        left = np.flatnonzero(shared)
        shared[np.delete(left, np.s_[::every])] = False
    return shared


def _observed(
    scene: Scene, view: View, shared: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the indices of points that a photo shows with usable brightness, and their stops."""
    seen = view.seen[shared[view.seen]]
    if not len(seen):
        return seen, np.zeros(0)
    photo = view.photo
    try:
        image, mask = photo.image(), photo.mask()
    except UserError:
        return seen[:0], np.zeros(0)
    samples = light_at(image, mask, view.camera, scene.points[seen])
    rows = samples.rows[samples.usable]
    return seen[rows], np.log2(samples.brightness[samples.usable])


@dataclass(frozen=True, eq=False)
class Light:
    """The brightness of an image at some points.

    Attributes:
        rows: [S] indices of the given points that are projected inside the image.
        brightness: [S] linear light, mean over 3 x 3 pixels and three channels; 1 is white.
    """

    rows: NDArray[np.int64]
    brightness: NDArray[np.float64]

    @property
    def usable(self) -> NDArray[np.bool_]:
        """[S] True if the brightness is neither too dark nor clipped."""
        return (self.brightness > DARKEST) & (self.brightness < BRIGHTEST)


def light_at(
    image: Tensor, mask: Tensor | None, camera: Camera, points: NDArray[np.float64]
) -> Light:
    """Measure the brightness of an image at points.

    Args:
        image: [H, W, 3] sRGB values, uint8 or floating point, on the CPU.
        mask: [H, W] bool, True if the pixel counts; None if every pixel counts.
        camera: The camera of the image.
        points: [P, 3] points in the local frame.
    """
    pixels, depths = camera.project(points)
    height, width = image.shape[:2]
    # All 3 x 3 pixels must be inside the image. This test also removes coordinates that are too
    # large for an integer index.
    inside = (pixels >= 1.0).all(axis=1) & (pixels < [width - 1, height - 1]).all(axis=1)
    rows = np.flatnonzero(inside & (depths > 0.0))
    right, down = (pixels[rows, axis].astype(np.int64) for axis in (0, 1))
    if mask is not None:
        counts = mask.numpy()
        kept = np.all([counts[down + y, right + x] for y, x in _NEIGHBOURS], axis=0)
        rows, right, down = rows[kept], right[kept], down[kept]
    values = image.numpy()
    light = sum(_linear(values[down + y, right + x]) for y, x in _NEIGHBOURS)
    return Light(rows, np.asarray(light).reshape(-1, 3).mean(axis=1) / len(_NEIGHBOURS))


def _linear(values: NDArray[np.generic]) -> NDArray[np.float64]:
    """Return linear light [S, 3] of sRGB values."""
    if values.dtype == np.uint8:
        return np.asarray(_of_eight_bits()[values])
    return np.asarray(decoded(torch.from_numpy(values.astype(np.float64))))


@cache
def _of_eight_bits() -> NDArray[np.float64]:
    """Return the linear light [256] of each 8-bit value."""
    return np.asarray(decoded(torch.arange(256, dtype=torch.float64) / 255.0))

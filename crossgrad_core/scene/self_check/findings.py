"""Notes on equal poses, far points, and photos that are equal, blurred, dark or bright."""

from collections.abc import Iterator, Sequence
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.contract.scene import Scene
from crossgrad_core.scene.frame import camera_centers
from crossgrad_core.scene.self_check.rig import Floats, Integers
from crossgrad_core.scene.wording import count, name_some

#: Poses are equal below this difference of their numbers, local units.
_SAME_POSE: Final = 1e-9
#: Points beyond this many times the median distance from the cameras are as good as at infinity.
_INFINITE: Final = 1e4
#: Pixels of the small photo that photos are compared by, in either direction.
_SMALL: Final = 16
#: Mean difference in levels of 255 below which two photos are almost equal.
_ALMOST: Final = 0.5
#: A photo is blurred below this share of the usual sharpness, and dark or bright beyond so many
#: stops from the usual brightness.
_BLURRED: Final = 0.15
_STOPS: Final = 4.0
#: Photos without which nothing is usual.
_FEWEST_PHOTOS: Final = 5
#: Differences of neighbouring pixels over those of pixels this far apart measure sharpness.
_APART: Final = 6


class Sketches:
    """Photos as far as they are compared with each other: pixels on a grid.

    Args:
        images: [H, W, 3] photos.

    Attributes:
        small: [V, 16, 16, 3] pixels, levels of 255.
        sharpness: [V] differences between neighbours over differences between pixels farther apart;
            NaN if those hardly differ.
        light: [V] mean level of the pixels, 0 to 255.
    """

    def __init__(self, images: Sequence[NDArray[np.uint8]]) -> None:
        chosen = [image.reshape(-1, 3).take(_grid(*image.shape[:2]), axis=0) for image in images]
        at, near, far = np.stack(chosen, axis=1).astype(np.float32)
        self.small: NDArray[np.float32] = at
        apart = np.abs(far - at).mean(axis=(1, 2, 3))
        unlike = np.abs(near - at).mean(axis=(1, 2, 3))
        self.sharpness = np.where(apart > 1.0, unlike / np.maximum(apart, 1.0), np.nan)
        self.light = at.mean(axis=(1, 2, 3))


@cache
def _grid(height: int, width: int) -> Integers:
    """Numbers of [3, 16, 16] pixels: on a grid, next to it, and farther to the right."""
    shares = (np.arange(_SMALL) + 0.5) / _SMALL
    down = (shares * height).astype(np.int64)
    right = (shares * max(width - _APART, 1)).astype(np.int64)
    columns = np.minimum(right + np.array([0, 1, _APART])[:, None], width - 1)
    return np.asarray(down[:, None] * width + columns[:, None])


def findings_of(
    scene: Scene, images: Sequence[NDArray[np.uint8]], names: Sequence[str]
) -> Iterator[str]:
    """Notes on a scene.

    Args:
        scene: The scene.
        images: [H, W, 3] photos that were looked at.
        names: Their names.
    """
    poses = np.stack([view.camera.world_to_camera.numpy() for view in scene.views])
    yield from _equal_poses(poses, [view.name for view in scene.views])
    yield from _far_points(scene.points, camera_centers(poses))
    if not images:
        return
    sketches = Sketches(images)
    if len(images) >= _FEWEST_PHOTOS:
        yield from _unusual(sketches, names)
    yield from _almost_equal(sketches, names)


def _equal_poses(poses: Floats, names: Sequence[str]) -> Iterator[str]:
    rounded = np.rint(poses[:, :3].reshape(len(poses), -1) / _SAME_POSE)
    equal = _repeated(rounded, names)
    if equal:
        photos = count(len(equal), "photo")
        yield f"check: {photos} with the pose of another one: {name_some(equal)}"


def _far_points(points: Floats, centers: Floats) -> Iterator[str]:
    if not len(points):
        return
    away = np.linalg.norm(points - np.median(centers, axis=0), axis=1)
    far = int((away > _INFINITE * np.median(away)).sum())
    if far:
        yield f"check: {count(far, 'point')} practically at infinity"


def _unusual(sketches: Sketches, names: Sequence[str]) -> Iterator[str]:
    sharpness = sketches.sharpness
    light = np.log2(sketches.light + 1.0) * 2.2
    known = np.isfinite(sharpness)
    if known.any():
        low = known & (sharpness < _BLURRED * np.median(sharpness[known]))
        if low.any():
            yield f"check: {_listed(low, names)} much less sharp than the others"
    off = np.abs(light - np.median(light)) > _STOPS
    if off.any() and off.mean() < 1.0 / _FEWEST_PHOTOS:
        yield f"check: {_listed(off, names)} much darker or brighter than the others"


def _almost_equal(sketches: Sketches, names: Sequence[str]) -> Iterator[str]:
    smalls = sketches.small.reshape(len(names), -1)
    textured = smalls.std(axis=1) > 1.0
    order = np.argsort(smalls.mean(axis=1))
    order = order[textured[order]]
    close = np.abs(np.diff(smalls[order], axis=0)).mean(axis=1) < _ALMOST
    pairs = [(names[order[i]], names[order[i + 1]]) for i in np.flatnonzero(close)]
    if pairs:
        shown = name_some([f"{min(pair)} and {max(pair)}" for pair in sorted(pairs)])
        yield f"check: photos that are almost equal: {shown}"


def _listed(which: NDArray[np.bool_], names: Sequence[str]) -> str:
    chosen = [name for name, chosen in zip(names, which, strict=True) if chosen]
    return f"{count(len(chosen), 'photo')} ({name_some(chosen)})"


def _repeated(rows: NDArray[np.float64], names: Sequence[str]) -> list[str]:
    """Names of the rows that equal an earlier row."""
    _, first, numbers = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    firsts = first[numbers.ravel()]
    return [name for i, name in enumerate(names) if firsts[i] != i]

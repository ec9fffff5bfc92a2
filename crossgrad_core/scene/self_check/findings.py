"""Notes on equal poses, far points, and photos that are equal, blurred, dark or bright."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.contract.scene import Scene
from crossgrad_core.scene.frame import camera_centers
from crossgrad_core.scene.self_check.rig import Floats
from crossgrad_core.scene.wording import count, name_some

#: Poses are equal below this difference of their numbers, local units.
_SAME_POSE: Final = 1e-9
#: Points beyond this many times the median distance from the cameras are as good as at infinity.
_INFINITE: Final = 1e4
#: Pixels of the small photo that photos are compared by, in either direction.
_SMALL: Final = 16
#: Mean difference in levels of 255 below which two photos are almost equal.
_ALMOST: Final = 0.5
#: Rows of a photo that sharpness is measured in.
_ROWS: Final = 6
#: A photo is blurred below this share of the usual sharpness, and dark or bright beyond so many
#: stops from the usual brightness.
_BLURRED: Final = 0.15
_STOPS: Final = 4.0
#: Photos without which nothing is usual.
_FEWEST_PHOTOS: Final = 5
#: Differences of neighbouring pixels over those of pixels this far apart measure sharpness.
_APART: Final = 6


@dataclass(frozen=True, eq=False)
class Sketch:
    """A photo as far as photos are compared with each other.

    Attributes:
        small: [16, 16, 3] some of its pixels, levels of 255.
        sharpness: Differences between neighbours over differences between pixels farther apart.
        light: Mean level of its pixels, 0 to 255.
    """

    small: NDArray[np.float32]
    sharpness: float
    light: float


def sketch_of(image: NDArray[np.uint8]) -> Sketch:
    """The sketch of a photo [H, W, 3]."""
    height, width = image.shape[:2]
    down = (np.arange(_SMALL) + 0.5) * height / _SMALL
    right = (np.arange(_SMALL) + 0.5) * width / _SMALL
    small = image[down.astype(np.int64)[:, None], right.astype(np.int64)].astype(np.float32)
    rows = image[:: max(1, height // _ROWS), :, 1].astype(np.int16)
    near = np.abs(rows[:, 1:] - rows[:, :-1]).mean()
    far = np.abs(rows[:, _APART:] - rows[:, :-_APART]).mean() if width > 2 * _APART else 0.0
    return Sketch(small, float(near / far) if far > 1.0 else np.nan, float(small.mean()))


def findings_of(scene: Scene, sketches: Sequence[Sketch], names: Sequence[str]) -> Iterator[str]:
    """Notes on a scene.

    Args:
        scene: The scene.
        sketches: Photos that were looked at.
        names: Their names.
    """
    poses = np.stack([view.camera.world_to_camera.numpy() for view in scene.views])
    yield from _equal_poses(poses, [view.name for view in scene.views])
    yield from _far_points(scene.points, camera_centers(poses))
    if len(sketches) >= _FEWEST_PHOTOS:
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


def _unusual(sketches: Sequence[Sketch], names: Sequence[str]) -> Iterator[str]:
    sharpness = np.array([each.sharpness for each in sketches])
    light = np.log2(np.array([each.light for each in sketches]) + 1.0) * 2.2
    known = np.isfinite(sharpness)
    if known.any():
        low = known & (sharpness < _BLURRED * np.median(sharpness[known]))
        if low.any():
            yield f"check: {_listed(low, names)} much less sharp than the others"
    off = np.abs(light - np.median(light)) > _STOPS
    if off.any() and off.mean() < 1.0 / _FEWEST_PHOTOS:
        yield f"check: {_listed(off, names)} much darker or brighter than the others"


def _almost_equal(sketches: Sequence[Sketch], names: Sequence[str]) -> Iterator[str]:
    if not sketches:
        return
    smalls = np.stack([each.small for each in sketches]).reshape(len(sketches), -1)
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

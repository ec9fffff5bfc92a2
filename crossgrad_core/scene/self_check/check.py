"""Check before training whether the poses, points and photos of a scene match."""

import logging
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from math import isfinite
from pathlib import Path
from time import perf_counter
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.contract.blocks import Json
from crossgrad_core.contract.scene import Scene
from crossgrad_core.errors import UserError
from crossgrad_core.scene.frame import camera_centers
from crossgrad_core.scene.photos.photos_ahead import fits
from crossgrad_core.scene.self_check.evidence import Floats, Integers, Pixels, pixels_of
from crossgrad_core.scene.self_check.verdict import Cause, Verdict, verdict_of
from crossgrad_core.scene.wording import count, name_some

#: Two poses are equal if all their elements differ by less than this number, in local units.
_SAME_POSE: Final = 1e-9
#: A point counts as infinitely far if its distance from the cameras is this many times the median
#: distance.
_INFINITE: Final = 1e4
#: Photos are compared as small copies with this number of pixels in each direction.
_SMALL: Final = 16
#: Two photos are almost equal if the mean difference of their pixels is below this number of levels
#: of 255.
_ALMOST: Final = 0.5
#: A photo counts as blurred if its sharpness is below this share of the median sharpness. A photo
#: counts as dark or bright if its brightness differs from the median by more than `_STOPS` stops.
_BLURRED: Final = 0.15
_STOPS: Final = 4.0
#: With fewer photos, no median is computed.
_FEWEST_PHOTOS: Final = 5
#: The sharpness is the difference of neighbouring pixels, divided by the difference of pixels at
#: this distance.
_APART: Final = 6


class Sketches:
    """Small copies of photos with their sharpness and brightness, for comparing photos.

    Args:
        images: The photos [H, W, 3].

    Attributes:
        small: [V, 16, 16, 3] pixels of the small copies, in levels of 255.
        sharpness: [V] differences of neighbouring pixels, divided by differences of more distant
            pixels. NaN if the distant pixels hardly differ.
        light: [V] mean level of all pixels in a small copy, 0 to 255.
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
    """Return one-dimensional pixel indices [3, 16, 16].

    The indices belong to a grid, to the right neighbours of its pixels, and to pixels farther to
    the right.
    """
    shares = (np.arange(_SMALL) + 0.5) / _SMALL
    down = (shares * height).astype(np.int64)
    right = (shares * max(width - _APART, 1)).astype(np.int64)
    columns = np.minimum(right + np.array([0, 1, _APART])[:, None], width - 1)
    return np.asarray(down[:, None] * width + columns[:, None])


def findings_of(
    scene: Scene, images: Sequence[NDArray[np.uint8]], names: Sequence[str]
) -> Iterator[str]:
    """Yield notes about unusual properties of a scene.

    Args:
        scene: The scene.
        images: The photos [H, W, 3] that were checked.
        names: Names of the photos.
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
        yield f"check: {photos} with the same pose as another photo: {name_some(equal)}"


def _far_points(points: Floats, centers: Floats) -> Iterator[str]:
    if not len(points):
        return
    away = np.linalg.norm(points - np.median(centers, axis=0), axis=1)
    far = int((away > _INFINITE * np.median(away)).sum())
    if far:
        yield f"check: {count(far, 'point')} extremely far away"


def _unusual(sketches: Sketches, names: Sequence[str]) -> Iterator[str]:
    sharpness = sketches.sharpness
    light = np.log2(sketches.light + 1.0) * 2.2
    has_sharpness = np.isfinite(sharpness)
    if has_sharpness.any():
        low = has_sharpness & (sharpness < _BLURRED * np.median(sharpness[has_sharpness]))
        if low.any():
            yield f"check: {_listed(low, names)} much less sharp than the other photos"
    off = np.abs(light - np.median(light)) > _STOPS
    if off.any() and off.mean() < 1.0 / _FEWEST_PHOTOS:
        yield f"check: {_listed(off, names)} much darker or brighter than the other photos"


def _almost_equal(sketches: Sketches, names: Sequence[str]) -> Iterator[str]:
    smalls = sketches.small.reshape(len(names), -1)
    textured = smalls.std(axis=1) > 1.0
    order = np.argsort(smalls.mean(axis=1))
    order = order[textured[order]]
    close = np.abs(np.diff(smalls[order], axis=0)).mean(axis=1) < _ALMOST
    pairs = [(names[order[i]], names[order[i + 1]]) for i in np.flatnonzero(close)]
    if pairs:
        shown = name_some([f"{min(pair)} and {max(pair)}" for pair in sorted(pairs)])
        yield f"check: some photos are almost equal: {shown}"


def _listed(which: NDArray[np.bool_], names: Sequence[str]) -> str:
    chosen = [name for name, chosen in zip(names, which, strict=True) if chosen]
    return f"{count(len(chosen), 'photo')} ({name_some(chosen)})"


def _repeated(rows: NDArray[np.float64], names: Sequence[str]) -> list[str]:
    """Return the names of all rows that are equal to an earlier row."""
    _, first, numbers = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    firsts = first[numbers.ravel()]
    return [name for i, name in enumerate(names) if firsts[i] != i]


_LOG = logging.getLogger(__name__)
_BYTES_OF_A_PIXEL: Final = 4


def checked(scene: Scene, path: Path, *, cache_mib: int, accept: bool = False) -> Scene:
    """Check a scene.

    The returned scene contains notes about contradictions, and the results in `check`.

    Args:
        scene: The scene.
        path: Folder of the scene, for messages.
        cache_mib: Memory for decoded photos, in MiB. If the photos need more memory, only evenly
            spaced photos are checked.
        accept: True to continue even if the scene as a whole is contradictory.

    Raises:
        UserError: The scene as a whole is contradictory.
    """
    begun = perf_counter()
    pixels = pixels_of(scene)
    _LOG.info("checking whether points, poses and photos match")
    looked_at = _looked_at(scene, cache_mib)
    views = [view for view in looked_at if _is_decoded(pixels, view)]
    undecoded = [scene.views[view].name for view in looked_at if view not in {*views}]
    names = [scene.views[view].name for view in views]
    verdict = verdict_of(scene, views, pixels)
    if verdict.all_wrong is not None and not accept:
        raise _refusal(verdict, verdict.all_wrong, path)
    warnings = tuple(_warnings(scene, verdict, undecoded))
    for warning in warnings:
        _LOG.warning("%s", warning)
    notes = (*warnings, *findings_of(scene, [pixels(view)[0] for view in views], names))
    figures: dict[str, Json] = {
        "seconds": round(perf_counter() - begun, 3),
        **_figures(verdict),
        "warnings": [*warnings],
        "disagreeing": [
            scene.views[view].name for cause in verdict.some_wrong for view in cause.views
        ],
    }
    return replace(scene, notes=(*scene.notes, *notes), check=figures)


def _is_decoded(pixels: Pixels, view: int) -> bool:
    """Decode a photo.

    Return False if the decoding fails. Code that needs the photo later reports the error.
    """
    try:
        pixels(view)
    except UserError:
        return False
    return True


def _looked_at(scene: Scene, cache_mib: int) -> Sequence[int]:
    """Return all views or, if their photos do not fit into memory, evenly spaced views."""
    number = len(scene.views)
    if fits(scene, cache_mib):
        return range(number)
    pixels = sum(view.camera.width * view.camera.height for view in scene.views)
    share = cache_mib * 2**20 / (_BYTES_OF_A_PIXEL * pixels)
    most = max(1, int(share * number))
    return sorted({i * number // most for i in range(most)})


def _figures(verdict: Verdict) -> dict[str, Json]:
    return {
        "verdict": _word(verdict),
        "compared": verdict.compared,
        "correlation": round(verdict.correlation, 4) if isfinite(verdict.correlation) else None,
        "in_frame": round(verdict.in_frame, 4) if isfinite(verdict.in_frame) else None,
        "cause": None if verdict.all_wrong is None else verdict.all_wrong.what,
        "notes": [*verdict.notes],
    }


def _word(verdict: Verdict) -> str:
    if verdict.all_wrong is not None:
        return "points, poses and photos do not match"
    if verdict.some_wrong:
        return "some photos do not match"
    return "agrees" if isfinite(verdict.correlation) else "not enough evidence"


def _warnings(scene: Scene, verdict: Verdict, undecoded: Sequence[str]) -> list[str]:
    messages = []
    if undecoded:
        messages.append(
            f"check: {count(len(undecoded), 'photo')} left out, because they cannot be "
            f"decoded: {name_some(undecoded)}"
        )
    if verdict.all_wrong is not None:
        messages.append(
            f"check: points, poses and photos do not match, accepted: {verdict.all_wrong.what}"
        )
    for cause in verdict.some_wrong:
        names = [scene.views[view].name for view in cause.views]
        messages.append(
            f"check: {count(len(names), 'photo')} not matching the points: "
            f"{name_some(names)}; {cause.what}: {cause.todo}"
        )
    return messages


def _refusal(verdict: Verdict, cause: Cause, path: Path) -> UserError:
    evidence = []
    if isfinite(verdict.in_frame):
        evidence.append(f"{verdict.in_frame:.0%} of the observed points are inside the photos")
    if isfinite(verdict.correlation):
        evidence.append(
            f"the colours of points and photos have a correlation of {verdict.correlation:.2f}"
        )
    return UserError(
        "the photos of the scene do not match its poses and points",
        where=path,
        expected="photos that show the SfM points at the positions that the poses predict",
        found=f"{cause.what} ({', '.join(evidence)})" if evidence else cause.what,
        todo=f"{cause.todo}; or train on the scene unchanged with --accept-scene, or with "
        "data.accept_scene: true in a settings file",
    )

"""The check of a scene against itself, before it is trained on."""

import logging
from collections.abc import Sequence
from dataclasses import replace
from math import isfinite
from pathlib import Path
from time import perf_counter
from typing import Final

from crossgrad_core.contract.scene import Scene
from crossgrad_core.contract.state import Json
from crossgrad_core.errors import UserError
from crossgrad_core.scene.photo_check import fits
from crossgrad_core.scene.self_check.evidence import Pixels, pixels_of
from crossgrad_core.scene.self_check.findings import findings_of
from crossgrad_core.scene.self_check.verdict import Cause, Verdict, verdict_of
from crossgrad_core.scene.wording import count, name_some

_LOG = logging.getLogger(__name__)
_BYTES_OF_A_PIXEL: Final = 4


def checked(scene: Scene, path: Path, *, cache_mib: int, accept: bool = False) -> Scene:
    """The scene with notes on what in it disagrees, and the figures in `check`.

    Args:
        scene: The scene.
        path: Its folder, for messages.
        cache_mib: Memory for decoded photos: of a scene that is larger, evenly spread photos are
            looked at.
        accept: Go on although the scene disagrees as a whole.

    Raises:
        UserError: The scene disagrees as a whole.
    """
    begun = perf_counter()
    pixels = pixels_of(scene)
    _LOG.info("checking points, poses and photos against each other")
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
    """Decode a photo. If it cannot be decoded, return False; who needs the photo reports why."""
    try:
        pixels(view)
    except UserError:
        return False
    return True


def _looked_at(scene: Scene, cache_mib: int) -> Sequence[int]:
    """All views, or as many as there is memory for, evenly spread."""
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
        return "the scene disagrees"
    if verdict.some_wrong:
        return "some photos disagree"
    return "agrees" if isfinite(verdict.correlation) else "cannot be told"


def _warnings(scene: Scene, verdict: Verdict, undecoded: Sequence[str]) -> list[str]:
    told = []
    if undecoded:
        told.append(
            f"check: {count(len(undecoded), 'photo')} left out, because the files cannot be "
            f"decoded: {name_some(undecoded)}"
        )
    if verdict.all_wrong is not None:
        told.append(f"check: the scene contradicts itself, accepted: {verdict.all_wrong.what}")
    for cause in verdict.some_wrong:
        names = [scene.views[view].name for view in cause.views]
        told.append(
            f"check: {count(len(names), 'photo')} at odds with the points: {name_some(names)}; "
            f"{cause.what}: {cause.todo}"
        )
    return told


def _refusal(verdict: Verdict, cause: Cause, path: Path) -> UserError:
    found = []
    if isfinite(verdict.in_frame):
        found.append(f"{verdict.in_frame:.0%} of the observed points are in frame")
    if isfinite(verdict.correlation):
        found.append(f"colours of points and photos correlate by {verdict.correlation:.2f}")
    return UserError(
        "the scene contradicts itself",
        where=path,
        expected="photos that show the points where their poses put them",
        found=f"{cause.what} ({', '.join(found)})" if found else cause.what,
        todo=f"{cause.todo}; or go on with the scene as it is: --accept-scene, or "
        "data.accept_scene: true in a file of settings",
    )

"""Runs of one scene must have measured the same views of the same photos."""

import re
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any, Final

from crossgrad_core.commands import UserError
from crossgrad_plugins.compare.run import Run

#: The note on the photos' sizes that every run writes.
_SIZES: Final = re.compile(r"^photos: (?P<sizes>\d.*?) from .*?/, (?P<how>.*)$")
_MOST_SHOWN: Final = 3


def check_scenes(runs: Sequence[Run]) -> list[str]:
    """Refuses runs of one scene that differ in split, photos, sizes or resize filter.

    Returns:
        Notes: of which runs photos cannot be compared, and of which scenes the regimes differ, so
        that only overall figures are compared.

    Raises:
        UserError: Figures of these runs do not compare, with the reason.
    """
    for scene in dict.fromkeys(run.scene for run in runs):
        own = [run for run in runs if run.scene == scene]
        for question in (_check_held_out, _check_photos, _check_sizes, _check_trained):
            question(scene, own)
    unknown = [run.name for run in runs if run.results.scene_marks is None]
    notes = []
    if unknown and len(runs) > 1:
        shown = ", ".join(unknown[:_MOST_SHOWN])
        notes.append(
            f"{len(unknown)} without scene.json, so that nobody can tell which photos they had: "
            f"{shown}"
        )
    return notes + [
        f"regimes are not compared on {scene}: its runs label the held-out views differently"
        for scene in differing_regimes(runs)
    ]


def differing_regimes(runs: Sequence[Run]) -> tuple[str, ...]:
    """Scenes of which runs give the same held-out views different regimes."""
    seen: dict[str, set[Hashable]] = {}
    for run in runs:
        labels = frozenset((view.name, view.regime) for view in run.results.views)
        seen.setdefault(run.scene, set()).add(labels)
    return tuple(scene for scene, labels in seen.items() if len(labels) > 1)


def _check_held_out(scene: str, runs: Sequence[Run]) -> None:
    found = _odd_one(runs, _held_out)
    if found is not None:
        first, second = found
        raise UserError(
            f"runs of {scene} were measured on different held-out views",
            where=f"{first.name}, {second.name}",
            expected="the same views in per_view.csv",
            found=_difference(_held_out(first), _held_out(second)),
            todo="compare runs with the same --split, --test-every and scene folder only",
        )


def _check_photos(scene: str, runs: Sequence[Run]) -> None:
    found = _odd_one([run for run in runs if run.results.scene_marks], _photos)
    if found is not None:
        raise UserError(
            f"runs of {scene} were measured against different photos",
            where=f"{found[0].name}, {found[1].name}",
            expected="the same photo files in scene.json",
            found="photos of the same name with other bytes, or other masks",
            todo="compare runs on one state of the scene's folder; another scene of the same name "
            "needs a comparison of its own",
        )


def _check_sizes(scene: str, runs: Sequence[Run]) -> None:
    found = _odd_one([run for run in runs if _sizes(run)], _sizes)
    if found is not None:
        raise UserError(
            f"runs of {scene} have photos of different sizes or resize filters",
            where=f"{found[0].name}, {found[1].name}",
            expected="one size: PSNR falls with the size of the photos",
            found=" against ".join(_sizes(run) for run in found),
            todo="compare runs with the same --max-size and images folder only",
        )


def _check_trained(scene: str, runs: Sequence[Run]) -> None:
    found = _odd_one([run for run in runs if run.results.scene_marks], _trained)
    if found is not None:
        first, second = found
        raise UserError(
            f"runs of {scene} were trained on different photos",
            where=f"{first.name}, {second.name}",
            expected="the same split in scene.json",
            found=_difference(_trained(first), _trained(second)),
            todo="compare runs with the same --split and --test-every only",
        )


def _odd_one(runs: Sequence[Run], mark: Callable[[Run], Hashable]) -> tuple[Run, Run] | None:
    """The first run, and the first one that has another mark."""
    return next(((runs[0], run) for run in runs if mark(run) != mark(runs[0])), None)


def _held_out(run: Run) -> frozenset[str]:
    return frozenset(view.name for view in run.results.views)


def _views(run: Run) -> Mapping[str, Any]:
    views = (run.results.scene_marks or {}).get("views")
    return views if isinstance(views, Mapping) else {}


def _trained(run: Run) -> frozenset[str]:
    return frozenset(name for name, view in _views(run).items() if view.get("trained"))


def _photos(run: Run) -> str:
    views = _views(run).items()
    return repr(sorted((n, _mark(v.get("photo")), _mark(v.get("mask"))) for n, v in views))


def _mark(file: object) -> object:
    """Return what a file is known by: its size and the digest of its ends."""
    return [file.get("bytes"), file.get("sha256")] if isinstance(file, dict) else file


def _sizes(run: Run) -> str:
    """Sizes and filter, as the run noted them; empty where it did not."""
    for note in run.summary.get("notes") or ():
        if found := _SIZES.match(str(note)):
            return f"{found['sizes']}, {found['how']}"
    return ""


def _difference(first: frozenset[str], second: frozenset[str]) -> str:
    sides = (("only in the first", first - second), ("only in the second", second - first))
    return "; ".join(
        f"{len(names)} {side}: {', '.join(sorted(names)[:_MOST_SHOWN])}"
        for side, names in sides
        if names
    )

"""Checks of runs before a comparison: their scenes, metrics and machines must agree."""

import re
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any, Final

from crossgrad_core.commands import UserError
from crossgrad_plugins.compare.quantity import (
    COSTS,
    CPU_SECONDS,
    SECONDS,
    ClockChoice,
    Cost,
    Quantity,
)
from crossgrad_plugins.compare.run import Run

#: Pattern of the note about photo sizes that every run writes.
_SIZES: Final = re.compile(r"^photos: (?P<sizes>\d.*?) from .*?/, (?P<how>.*)$")
_MOST_SHOWN: Final = 3
#: Key of the definition of how renders are compared; this definition applies to every metric.
_RENDERS: Final = "renders"
#: The environment fields that identify a machine. The fields in `_SHARE` give the part of the
#: machine that a run may use.
_MACHINE: Final = {"cpu": "processor", "gpu": "GPU", "device": "device"}
_SHARE: Final = {"cpu_cores": "number of cores", "torch_threads": "number of threads"}
#: Maximum relative difference between the measured speeds of machines: in wall-clock time, and in
#: CPU time. CPU time varies more than wall-clock time, because other processes share the caches and
#: cores.
_SAME_SPEED: Final = {"rate": 0.1, "cpu_rate": 0.25}
#: A machine counts as busy if its mean load is above its number of cores plus this value.
_BUSY: Final = 0.5
#: Name of wall-clock seconds in notes. CPU seconds may be comparable even if wall-clock seconds are
#: not.
_CLOCK: Final = "wall-clock seconds"
_NEVER_RECORDED: Final = "no run recorded them"


def check_scenes(runs: Sequence[Run]) -> list[str]:
    """Refuse runs of a scene that differ in split, photos, photo sizes or resize filter.

    Returns:
        Notes about runs whose photos cannot be checked, and about scenes whose regimes differ. For
        scenes with different regimes, only overall metrics are compared.

    Raises:
        UserError: The metrics of the runs are not comparable; the message gives the reason.
    """
    for scene in dict.fromkeys(run.scene for run in runs):
        on_scene = [run for run in runs if run.scene == scene]
        for question in (_check_held_out, _check_photos, _check_sizes, _check_trained):
            question(scene, on_scene)
    unknown = [run.name for run in runs if run.results.scene_marks is None]
    notes = []
    if unknown and len(runs) > 1:
        shown = ", ".join(unknown[:_MOST_SHOWN])
        notes.append(f"{len(unknown)} without scene.json, so their photos are not known: {shown}")
    return notes + [
        (
            f"regimes of scene {scene} are not compared: its runs label the held-out "
            "views differently"
        )
        for scene in differing_regimes(runs)
    ]


def differing_regimes(runs: Sequence[Run]) -> tuple[str, ...]:
    """Return the scenes for which runs assign different regimes to a held-out view."""
    seen: dict[str, set[Hashable]] = {}
    for run in runs:
        labels = frozenset((view.name, view.regime) for view in run.results.views)
        seen.setdefault(run.scene, set()).add(labels)
    return tuple(scene for scene, labels in seen.items() if len(labels) > 1)


def _check_held_out(scene: str, runs: Sequence[Run]) -> None:
    pair = _odd_one(runs, _held_out)
    if pair is not None:
        first, second = pair
        raise UserError(
            f"runs of scene {scene} were evaluated on different held-out views",
            where=f"{first.name}, {second.name}",
            expected="the same views in per_view.csv",
            found=_difference(_held_out(first), _held_out(second)),
            todo="compare only runs with the same --split, --test-every and scene folder",
        )


def _check_photos(scene: str, runs: Sequence[Run]) -> None:
    pair = _odd_one([run for run in runs if run.results.scene_marks], _photos)
    if pair is not None:
        raise UserError(
            f"runs of scene {scene} were evaluated against different photos",
            where=f"{pair[0].name}, {pair[1].name}",
            expected="the same photo files in scene.json",
            found="photos of the same name with different bytes or masks",
            todo="compare only runs on the same state of the scene folder; compare another "
            "scene of the same name separately",
        )


def _check_sizes(scene: str, runs: Sequence[Run]) -> None:
    pair = _odd_one([run for run in runs if _sizes(run)], _sizes)
    if pair is not None:
        raise UserError(
            f"runs of scene {scene} were evaluated at different photo sizes or with "
            "different resize filters",
            where=f"{pair[0].name}, {pair[1].name}",
            expected="the same size for all runs: PSNR falls with the size of the photos",
            found=" against ".join(_sizes(run) for run in pair),
            todo="compare only runs with the same --max-size and images folder",
        )


def _check_trained(scene: str, runs: Sequence[Run]) -> None:
    pair = _odd_one([run for run in runs if run.results.scene_marks], _trained)
    if pair is not None:
        first, second = pair
        raise UserError(
            f"runs of scene {scene} were trained on different photos",
            where=f"{first.name}, {second.name}",
            expected="the same split in scene.json",
            found=_difference(_trained(first), _trained(second)),
            todo="compare only runs with the same --split and --test-every",
        )


def _odd_one(runs: Sequence[Run], mark: Callable[[Run], Hashable]) -> tuple[Run, Run] | None:
    """Return the first run and the first run whose value differs from it; None if all agree."""
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
    """Return the size and digest of a file entry; return any other value unchanged."""
    return [file.get("bytes"), file.get("sha256")] if isinstance(file, dict) else file


def _sizes(run: Run) -> str:
    """Return photo sizes and resize filter from a run's notes, or nothing if there is no note."""
    for note in run.summary.get("notes") or ():
        if match := _SIZES.match(str(note)):
            return f"{match['sizes']}, {match['how']}"
    return ""


def _difference(first: frozenset[str], second: frozenset[str]) -> str:
    sides = (("only in the first run", first - second), ("only in the second run", second - first))
    return "; ".join(
        f"{len(names)} {side}: {', '.join(sorted(names)[:_MOST_SHOWN])}"
        for side, names in sides
        if names
    )


def quantities_of(
    runs: Sequence[Run], name: str, margin: float | None
) -> tuple[tuple[Quantity, ...], list[str]]:
    """Return the comparable metrics, main metric first, and notes about the other metrics.

    Args:
        runs: The runs.
        name: Name of the main metric.
        margin: Margin of the main metric; None for the default margin.

    Raises:
        UserError: No run has the main metric, or the runs differ in the definition of the metric or
            of how renders are compared.
    """
    offered = dict.fromkeys(key for run in runs for key in _overall(run) if key != "views")
    measured = [key for key in offered if any(run.final(key) is not None for run in runs)]
    if not measured:
        raise UserError(
            "no run has metrics, because no run held out a photo",
            where=runs[0].name,
            todo="repeat the runs without --split none; if the scene has few photos, add more",
        )
    if name not in measured:
        raise UserError(
            "no run has this metric",
            where="--metric",
            expected=f"one of {', '.join(measured)}",
            found=name,
            todo="choose another metric, or repeat the runs with it: crossgrad run --metrics NAME",
        )
    for key in (_RENDERS, name):
        _check_definition(runs, key)
    notes, kept = [], [name]
    for key in measured:
        if key == name:
            continue
        if len(_definitions(runs, key)) > 1:
            notes.append(f"{key} is not compared: the runs define it differently")
        elif lacking := [run.name for run in runs if key not in _overall(run)]:
            notes.append(f"{key} is not compared: {lacking[0]} and other runs did not measure it"
                         if len(lacking) > 1 else
                         f"{key} is not compared: {lacking[0]} did not measure it")  # fmt: skip
        else:
            kept.append(key)
    falling = {str(key) for run in runs for key in run.summary.get("falling") or ()}
    quantities = (
        Quantity.of(key, margin if key == name else None, falls=key in falling) for key in kept
    )
    return tuple(quantities), notes


def _check_definition(runs: Sequence[Run], key: str) -> None:
    definitions = _definitions(runs, key)
    if len(definitions) > 1:
        (first, one), (second, other), *_ = ((text, run) for text, run in definitions.items())
        raise UserError(
            f"the runs define {key} differently"
            if key != _RENDERS
            else "the runs computed their metrics under different rules",
            where=f"{one}, {other}",
            expected="the same definition in every summary.json",
            found=f"{first!r} in one run, {second!r} in the other",
            todo="compare runs of one version of crossgrad, or repeat the runs of the other "
            "version",
        )


def _definitions(runs: Sequence[Run], key: str) -> dict[str, str]:
    """Return the first run with each definition; runs without a definition are ignored."""
    definitions: dict[str, str] = {}
    for run in runs:
        text = (run.summary.get("definitions") or {}).get(key)
        if text is not None:
            definitions.setdefault(str(text), run.name)
    return definitions


def _overall(run: Run) -> dict[str, Any]:
    return dict(run.summary.get("overall") or {})


def comparable_costs(runs: Sequence[Run], clock: ClockChoice) -> tuple[tuple[Cost, ...], list[str]]:
    """Return the costs that can be compared, and notes about the costs that cannot.

    Args:
        runs: The runs.
        clock: Which seconds are compared: wall-clock, CPU or `auto`. With `auto`, every kind of
            seconds that is comparable is used.

    Raises:
        UserError: The requested seconds are not comparable; the message gives the reason.
    """
    reasons = {SECONDS: _why_no_wall(runs), CPU_SECONDS: _why_no_cpu(runs)}
    wanted = {ClockChoice.WALL: SECONDS, ClockChoice.CPU: CPU_SECONDS}.get(clock)
    if wanted is not None and reasons[wanted]:
        raise UserError(
            f"{wanted.title} of these runs cannot be compared",
            where=f"--clock {clock}",
            found=reasons[wanted],
            todo="leave --clock out to compare the quality at equal steps and views"
            + ("" if reasons[CPU_SECONDS] else "; --clock cpu compares CPU seconds"),
        )
    left_out = {cost for cost, reason in reasons.items() if reason}
    if clock is not ClockChoice.AUTO:
        left_out |= {SECONDS, CPU_SECONDS} - {wanted}
    notes = [
        f"{_CLOCK if cost is SECONDS else cost.title} are not compared: {reason}"
        for cost, reason in reasons.items()
        if reason and clock is ClockChoice.AUTO and reason != _NEVER_RECORDED
    ]
    return tuple(cost for cost in COSTS if cost not in left_out), notes


def _why_no_wall(runs: Sequence[Run]) -> str:
    """Return why wall-clock seconds are not comparable, or an empty text if they are."""
    return (
        _other_machine(runs, {**_MACHINE, **_SHARE})
        or _busy(runs)
        or _other_speed(runs, "rate")
        or _unrecorded(runs, SECONDS)
    )


def _why_no_cpu(runs: Sequence[Run]) -> str:
    return (
        _unrecorded(runs, CPU_SECONDS)
        or _other_machine(runs, _MACHINE)
        or _threads(runs)
        or _other_speed(runs, "cpu_rate")
    )


def _other_machine(runs: Sequence[Run], fields: dict[str, str]) -> str:
    first = runs[0]
    for run in runs[1:]:
        for field, words in fields.items():
            one, other = _environment(first).get(field), _environment(run).get(field)
            if one != other:
                return f"{words} {one} of {first.name}, {other} of {run.name}"
    return ""


def _other_speed(runs: Sequence[Run], name: str) -> str:
    """Return how the measured machine speed differs between runs; empty if it does not."""
    speeds = [(run.number("environment", "calibration", name), run) for run in runs]
    rates = [(rate, run) for rate, run in speeds if rate is not None]
    if len(rates) < len(runs):
        return ""
    (low, slow), (high, fast) = min(rates, key=_first), max(rates, key=_first)
    if high <= (1.0 + _SAME_SPEED[name]) * low:
        return ""
    return (
        f"the machine's calibration was {high / low - 1.0:.0%} faster at {fast.name} "
        f"than at {slow.name}"
    )


def _first(pair: tuple[float, Run]) -> float:
    return pair[0]


def _busy(runs: Sequence[Run]) -> str:
    for run in runs:
        load, cores = (
            run.number("environment", "load", "mean"),
            run.number("environment", "cpu_cores"),
        )
        if load is not None and cores is not None and load > cores + _BUSY:
            return (
                f"the machine was busy during {run.name}: its load was {load:.1f} on "
                f"{cores:g} cores"
            )
    return ""


def _threads(runs: Sequence[Run]) -> str:
    """Return why different thread counts make CPU seconds incomparable, or an empty text.

    Threads that wait in a loop use CPU seconds without doing work.
    """
    for run in runs:
        threads = run.number("environment", "torch_threads")
        if threads is not None and threads > 1:
            return f"they can be compared only with one thread, and {run.name} used {threads:g}"
    return ""


def _unrecorded(runs: Sequence[Run], cost: Cost) -> str:
    lacking = [run.name for run in runs if run.spent(cost) is None]
    if not lacking:
        return ""
    return _NEVER_RECORDED if len(lacking) == len(runs) else f"{lacking[0]} did not record them"


def _environment(run: Run) -> dict[str, Any]:
    return dict(run.summary.get("environment") or {})

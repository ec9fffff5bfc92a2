"""Of each arm and scene the best parameters: tuned on some seeds, to be measured on others."""

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from statistics import mean
from typing import Any, TypeAlias

from crossgrad_core.commands import UserError, listed
from crossgrad_plugins.sweep.grid import Arm, Choice, Grid, Settings, choices, scene_name
from crossgrad_plugins.sweep.job import Job
from crossgrad_plugins.sweep.run_status import Standing, figure

#: Settings of which a run has one.
LENGTHS = frozenset({"steps", "max_views", "seconds"})
#: Seeds that the new grid has.
SEEDS = 3
#: Configuration and scene -> seed -> the metric, None where the run failed or has none; a run that
#: is left to do is not there.
Ends: TypeAlias = Mapping[tuple[str, str], Mapping[int, float | None]]


def best_grid(
    grid: Grid, cells: Iterable[Job], standings: Iterable[Standing], folder: Path
) -> tuple[dict[str, Any], list[str]]:
    """A grid with each arm twice: as it is, and on each scene with its best parameters.

    Its seeds are others than those that the parameters were chosen on.

    Args:
        grid: The grid in which parameters vary.
        cells: Its combinations.
        standings: How far they are.
        folder: Where the new grid is going to be.

    Returns:
        The content of its file, and notes: on parameters of which a run failed, which are no
        candidates, and on those that are best at the end of their values.

    Raises:
        UserError: Of some arm and scene a run is left to do, all values failed, or nothing varies.
    """
    if len(choices(grid)) == len(grid.arms):
        raise UserError(
            "nothing varies in any arm of the grid: there is nothing to choose",
            where=grid.name or "the grid",
            expected="an arm whose parameters have several values",
            todo="run the grid as it is",
        )
    ends = _ends(grid, cells, standings)
    first = max(grid.seeds) + 1
    notes: list[str] = []
    arms: list[dict[str, Any]] = []
    for arm in grid.arms:
        own = [choice for choice in choices(grid) if choice.arm.name == arm.name]
        if len(own) == 1:
            # Nothing varies in it: an arm that the others are held against.
            for scene in map(scene_name, grid.scenes):
                _check_ended([(own[0], ends[own[0].label, scene])], scene, grid)
            # As parameters, which may change what the settings say, not as settings beside them.
            fixed = {name: {"values": [value]} for name, value in own[0].parameters.items()}
            as_it_is = {"name": arm.name, "settings": arm.settings, "by_scene": arm.by_scene}
            arms.append({**as_it_is, **({"parameters": fixed} if fixed else {})})
            continue
        best = {}
        for place in grid.scenes:
            scene = scene_name(place)
            chosen, without = _best(own, scene, ends, grid)
            best[scene] = _with_parameters(chosen, grid.base, place)
            notes += [*without, *_at_the_end(chosen, scene, own)]
        arms += _twice(arm, best)
    content = {
        **({} if grid.name is None else {"name": f"{grid.name}-best"}),
        "description": grid.description,
        "base": grid.base,
        "scenes": [each and os.path.relpath(each, folder.resolve()) for each in grid.scenes],
        "seeds": list(range(first, first + SEEDS)),
        "arms": arms,
        "metric": grid.metric.model_dump(),
    }
    return content, notes


def _twice(arm: Arm, best: Mapping[str, dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """The arm as it is, and with its best parameters by scene."""
    own = {"settings": arm.settings}
    yield {"name": arm.name, **own, "by_scene": arm.by_scene}
    yield {"name": f"{arm.name}, best", **own, "by_scene": best}


def _with_parameters(chosen: Choice, base: Settings, scene: str | None) -> dict[str, Any]:
    """Settings by scene with which an arm has the parameters that were chosen.

    Its own settings by scene win, as before. Where one layer cannot say that, they are all that the
    best runs were started with.
    """
    arm, name = chosen.arm, scene_name(scene)
    wanted = chosen.settings(base, scene)
    short = _below(chosen.parameters, arm.by_scene.get(name, {}))
    again = Choice(arm=arm.model_copy(update={"by_scene": {name: short}}), parameters={})
    if again.settings(base, scene) == wanted:
        return short
    return {key: value for key, value in wanted.items() if key != "scene"}


def _below(values: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """Values below settings that win over them, in one layer.

    What another component is chosen for takes the options of the first with it, and a run has one
    length.
    """
    lengths = LENGTHS if LENGTHS & own.keys() else frozenset()
    components = {name.removesuffix(".name") for name in own if name.endswith(".name")}
    components |= {name for name in own if "." not in name}
    kept = {
        name: value
        for name, value in values.items()
        if name not in lengths and name.partition(".")[0] not in components
    }
    return {**kept, **own}


def _ends(grid: Grid, cells: Iterable[Job], standings: Iterable[Standing]) -> Ends:
    """What the runs that are at their ends came to."""
    known = {each.job.id: each for each in standings}
    found: dict[tuple[str, str], dict[int, float | None]] = {}
    for job in cells:
        own = found.setdefault((job.label, job.scene), {})
        if known[job.id].state in {"finished", "failed"}:
            own[job.seed] = figure(known[job.id], grid.metric.name)
    return found


def _best(own: Sequence[Choice], scene: str, ends: Ends, grid: Grid) -> tuple[Choice, list[str]]:
    """The best of an arm's choices on a scene, and notes on those that were none.

    All of them are measured on the same seeds: one of which a run failed is no candidate.
    """
    found = [(choice, ends[choice.label, scene]) for choice in own]
    _check_ended(found, scene, grid)
    sign = 1.0 if grid.metric.goal == "maximize" else -1.0
    notes: list[str] = []
    candidates: list[tuple[float, Choice]] = []
    for choice, by_seed in found:
        values = [value for value in by_seed.values() if value is not None]
        if len(values) == len(by_seed):
            candidates.append((sign * mean(values), choice))
        else:
            notes.append(_no_candidate(choice, scene, by_seed, grid))
    if not candidates:
        raise _nothing_to_choose(own, scene, grid)
    return max(candidates, key=lambda each: each[0])[1], notes


def _nothing_to_choose(own: Sequence[Choice], scene: str, grid: Grid) -> UserError:
    return UserError(
        "no parameters can be chosen",
        where=f"{scene}, arm {own[0].arm.name}",
        expected=f"a value with a finished run of each seed that has {grid.metric.name}",
        found=f"for each of the {len(own)} a run that failed or has no such figure",
        todo="see why they failed with --list; change the values, or the name of the metric",
    )


def _check_ended(
    found: Sequence[tuple[Choice, Mapping[int, float | None]]], scene: str, grid: Grid
) -> None:
    ended = sum(len(by_seed) == len(set(grid.seeds)) for _, by_seed in found)
    if ended < len(found):
        raise UserError(
            "the best parameters are not known yet",
            where=f"{scene}, arm {found[0][0].arm.name}",
            expected="a finished run of each value and seed",
            found=f"{ended} of {len(found)} values finished",
            todo="finish the sweep first: the same command without --best",
        )


def _no_candidate(
    choice: Choice, scene: str, by_seed: Mapping[int, float | None], grid: Grid
) -> str:
    seeds = [seed for seed, value in by_seed.items() if value is None]
    return (
        f"{scene}, {choice.label}: not among the candidates, as the run failed or has no "
        f"{grid.metric.name} with seed {listed(map(str, seeds))}"
    )


def _at_the_end(best: Choice, scene: str, own: list[Choice]) -> Iterator[str]:
    for name, value in best.parameters.items():
        values = [each.parameters[name] for each in own]
        numbers = [each for each in values if isinstance(each, int | float)]
        if (
            len(numbers) == len(values)
            and value in {min(numbers), max(numbers)}
            and len(set(numbers)) > 1
        ):
            yield f"{scene}, {best.arm.name}: the best {name} is {value}, at the end of its values"

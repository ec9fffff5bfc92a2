"""The best parameters of each arm and scene: chosen on some seeds, to be tested on others."""

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from statistics import mean
from typing import Any, TypeAlias

from crossgrad_core.commands import UserError, listed
from crossgrad_plugins.sweep.grid import Arm, Choice, Grid, Settings, choices, scene_name
from crossgrad_plugins.sweep.job import Job
from crossgrad_plugins.sweep.run_status import Standing, figure

#: Settings that determine the length of a run. A run uses only one of these settings.
LENGTHS = frozenset({"steps", "max_views", "seconds"})
#: Number of seeds in the new grid.
SEEDS = 3
#: Configuration and scene -> seed -> the metric. The metric is None if the run failed or did not
#: compute the metric. Runs that have not ended are not in the mapping.
Ends: TypeAlias = Mapping[tuple[str, str], Mapping[int, float | None]]


def best_grid(
    grid: Grid, cells: Iterable[Job], standings: Iterable[Standing], folder: Path
) -> tuple[dict[str, Any], list[str]]:
    """Return a grid with each arm twice: unchanged, and with the best parameters of each scene.

    The seeds of the new grid differ from the seeds with which the parameters were chosen.

    Args:
        grid: The grid with the varied parameters.
        cells: All combinations of the grid.
        standings: State of each run.
        folder: Folder of the new grid.

    Returns: The content of the new grid file, and notes. Notes name parameter values that are
    excluded because a run failed, and best values at the end of the tested range.

    Raises:
        UserError: A run of an arm and scene has not ended, all parameter values failed, or the grid
            varies no parameter.
    """
    if len(choices(grid)) == len(grid.arms):
        raise UserError(
            "no arm of the grid has several values to choose from",
            where=grid.name or "the grid",
            expected="an arm with a parameter that has several values",
            todo="run the grid without --best",
        )
    ends = _ends(grid, cells, standings)
    first = max(grid.seeds) + 1
    notes: list[str] = []
    arms: list[dict[str, Any]] = []
    for arm in grid.arms:
        arm_choices = [choice for choice in choices(grid) if choice.arm.name == arm.name]
        if len(arm_choices) == 1:
            # This arm has only one configuration, so it is the reference for the other arms.
            for scene in map(scene_name, grid.scenes):
                _check_ended([(arm_choices[0], ends[arm_choices[0].label, scene])], scene, grid)
            # Write the values as parameters, because parameters can override settings, but not the
            # other way round.
            fixed = {name: {"values": [value]} for name, value in arm_choices[0].parameters.items()}
            as_it_is = {"name": arm.name, "settings": arm.settings, "by_scene": arm.by_scene}
            arms.append({**as_it_is, **({"parameters": fixed} if fixed else {})})
            continue
        best = {}
        for scene_folder in grid.scenes:
            scene = scene_name(scene_folder)
            chosen, without = _best(arm_choices, scene, ends, grid)
            best[scene] = _with_parameters(chosen, grid.base, scene_folder)
            notes += [*without, *_at_the_end(chosen, scene, arm_choices)]
        arms += _twice(arm, best)
    content = {
        **({} if grid.name is None else {"name": f"{grid.name}-best"}),
        "description": grid.description,
        "base": grid.base,
        "scenes": [path and os.path.relpath(path, folder.resolve()) for path in grid.scenes],
        "seeds": list(range(first, first + SEEDS)),
        "arms": arms,
        "metric": grid.metric.model_dump(),
    }
    return content, notes


def _twice(arm: Arm, best: Mapping[str, dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Yield the unchanged arm, and the arm with its best parameters by scene."""
    shared = {"settings": arm.settings}
    yield {"name": arm.name, **shared, "by_scene": arm.by_scene}
    yield {"name": f"{arm.name}, best", **shared, "by_scene": best}


def _with_parameters(chosen: Choice, base: Settings, scene: str | None) -> dict[str, Any]:
    """Return settings by scene that give an arm the chosen parameters.

    If the arm already has settings for a scene, they override the chosen parameters. If one set of
    settings cannot express the result, all settings of the best runs are returned.
    """
    arm, name = chosen.arm, scene_name(scene)
    wanted = chosen.settings(base, scene)
    short = _below(chosen.parameters, arm.by_scene.get(name, {}))
    again = Choice(arm=arm.model_copy(update={"by_scene": {name: short}}), parameters={})
    if again.settings(base, scene) == wanted:
        return short
    return {key: value for key, value in wanted.items() if key != "scene"}


def _below(values: Mapping[str, Any], overriding: Mapping[str, Any]) -> dict[str, Any]:
    """Merge values with the settings that override them.

    If a setting chooses another component, the options of the replaced component are removed. A run
    has only one length setting. If a setting gives a length, a length among the values is therefore
    removed.
    """
    lengths = LENGTHS if LENGTHS & overriding.keys() else frozenset()
    components = {name.removesuffix(".name") for name in overriding if name.endswith(".name")}
    components |= {name for name in overriding if "." not in name}
    kept = {
        name: value
        for name, value in values.items()
        if name not in lengths and name.partition(".")[0] not in components
    }
    return {**kept, **overriding}


def _ends(grid: Grid, cells: Iterable[Job], standings: Iterable[Standing]) -> Ends:
    """Return the metrics of the runs that have ended."""
    by_id = {standing.job.id: standing for standing in standings}
    ends: dict[tuple[str, str], dict[int, float | None]] = {}
    for job in cells:
        by_seed = ends.setdefault((job.label, job.scene), {})
        if by_id[job.id].state in {"finished", "failed"}:
            by_seed[job.seed] = figure(by_id[job.id], grid.metric.name)
    return ends


def _best(
    arm_choices: Sequence[Choice], scene: str, ends: Ends, grid: Grid
) -> tuple[Choice, list[str]]:
    """Return the best configuration of an arm on a scene, and notes about excluded ones.

    All configurations are compared on the same seeds. A configuration with a failed run is
    therefore excluded.
    """
    results = [(choice, ends[choice.label, scene]) for choice in arm_choices]
    _check_ended(results, scene, grid)
    sign = 1.0 if grid.metric.goal == "maximize" else -1.0
    notes: list[str] = []
    candidates: list[tuple[float, Choice]] = []
    for choice, by_seed in results:
        values = [value for value in by_seed.values() if value is not None]
        if len(values) == len(by_seed):
            candidates.append((sign * mean(values), choice))
        else:
            notes.append(_no_candidate(choice, scene, by_seed, grid))
    if not candidates:
        raise _nothing_to_choose(arm_choices, scene, grid)
    return max(candidates, key=lambda candidate: candidate[0])[1], notes


def _nothing_to_choose(arm_choices: Sequence[Choice], scene: str, grid: Grid) -> UserError:
    return UserError(
        "the best parameters cannot be chosen",
        where=f"{scene}, arm {arm_choices[0].arm.name}",
        expected=f"a value whose runs all finished and have {grid.metric.name}",
        found=f"each of the {len(arm_choices)} values has a run that failed or has no such metric",
        todo="look for the reasons with --list; change the values, or the name of the metric",
    )


def _check_ended(
    results: Sequence[tuple[Choice, Mapping[int, float | None]]], scene: str, grid: Grid
) -> None:
    ended = sum(len(by_seed) == len(set(grid.seeds)) for _, by_seed in results)
    if ended < len(results):
        raise UserError(
            "the best parameters cannot be chosen before all runs have finished",
            where=f"{scene}, arm {results[0][0].arm.name}",
            expected="a finished run for each value and seed",
            found=f"{ended} of {len(results)} values finished",
            todo="finish the sweep first: run the same command without --best",
        )


def _no_candidate(
    choice: Choice, scene: str, by_seed: Mapping[int, float | None], grid: Grid
) -> str:
    seeds = [seed for seed, value in by_seed.items() if value is None]
    return (
        f"{scene}, {choice.label}: not a candidate, because a run failed or has no "
        f"{grid.metric.name} with seed {listed(map(str, seeds))}"
    )


def _at_the_end(best: Choice, scene: str, arm_choices: list[Choice]) -> Iterator[str]:
    for name, value in best.parameters.items():
        values = [choice.parameters[name] for choice in arm_choices]
        numbers = [number for number in values if isinstance(number, int | float)]
        if (
            len(numbers) == len(values)
            and value in {min(numbers), max(numbers)}
            and len(set(numbers)) > 1
        ):
            yield (
                f"{scene}, {best.arm.name}: the best {name} is {value}, the smallest or "
                "largest of its values"
            )

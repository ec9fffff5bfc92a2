"""Of each arm and scene the best parameters: tuned on some seeds, to be measured on others."""

import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from statistics import mean
from typing import Any

from crossgrad_core.commands import UserError
from crossgrad_plugins.sweep.grid import Arm, Choice, Grid, choices, scene_name
from crossgrad_plugins.sweep.job import Job
from crossgrad_plugins.sweep.standing import Standing, figure

#: Seeds that the new grid has.
SEEDS = 3


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
        The content of its file, and notes on parameters that are best at the end of their values.

    Raises:
        UserError: Of some arm and scene nothing is finished, or nothing varies.
    """
    found = _means(grid, cells, standings)
    first = max(grid.seeds) + 1
    notes: list[str] = []
    arms: list[dict[str, Any]] = []
    for arm in grid.arms:
        own = [choice for choice in choices(grid) if choice.arm.name == arm.name]
        best = {}
        for scene in map(scene_name, grid.scenes):
            chosen = _best(own, scene, found, grid)
            best[scene] = chosen.parameters
            notes += _at_the_end(chosen, scene, own)
        arms += _twice(arm, best)
    content = {
        "name": f"{grid.name or 'grid'}-best",
        "description": grid.description,
        "base": grid.base,
        "scenes": [each and os.path.relpath(each, folder.resolve()) for each in grid.scenes],
        "seeds": list(range(first, first + SEEDS)),
        "arms": arms,
        "metric": grid.metric.model_dump(),
    }
    return content, notes


def _twice(arm: Arm, best: Mapping[str, dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """The arm as it is, and with its best parameters; its own settings by scene win, as before."""
    own = {"settings": arm.settings}
    by_scene = {scene: {**values, **arm.by_scene.get(scene, {})} for scene, values in best.items()}
    yield {"name": arm.name, **own, "by_scene": arm.by_scene}
    yield {"name": f"{arm.name}, best", **own, "by_scene": by_scene}


def _means(
    grid: Grid, cells: Iterable[Job], standings: Iterable[Standing]
) -> dict[tuple[str, str], float]:
    """Configuration and scene -> mean of the metric over seeds."""
    values = {each.job.id: figure(each, grid.metric.name) for each in standings}
    known: dict[tuple[str, str], list[float]] = {}
    for job in cells:
        if (value := values[job.id]) is not None:
            known.setdefault((job.label, job.scene), []).append(value)
    return {key: mean(each) for key, each in known.items()}


def _best(
    own: list[Choice], scene: str, found: Mapping[tuple[str, str], float], grid: Grid
) -> Choice:
    sign = 1.0 if grid.metric.goal == "maximize" else -1.0
    known = [each for each in own if (each.label, scene) in found]
    if len(own) < 2 or len(known) < len(own):  # noqa: PLR2004 - one is no choice
        raise UserError(
            "the best parameters are not known yet",
            where=f"{scene}, arm {own[0].arm.name}",
            expected="parameters that vary, and a finished run of each of their values",
            found=f"{len(known)} of {len(own)} finished",
            todo="finish the sweep first: the same command without --best",
        )
    return max(known, key=lambda each: sign * found[each.label, scene])


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

"""The final quality of runs by length, and the gain of longer runs."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from crossgrad_plugins.compare.arms import Cells, Length
from crossgrad_plugins.compare.contrasts import Contrast, contrast, judged
from crossgrad_plugins.compare.quantity import Cost, Quantity
from crossgrad_plugins.compare.ranking import standings


@dataclass(frozen=True)
class Point:
    """The runs of an arm on a scene with one length.

    Attributes:
        arm: The arm.
        scene: The scene.
        length: Budget of the runs, as text.
        spent: Cost -> mean amount that the runs spent.
        mean: Mean of the final metric.
        spread: Standard deviation of the final metric over seeds; NaN for one run.
        seeds: Number of runs.
    """

    arm: str
    scene: str
    length: str
    spent: dict[str, float]
    mean: float
    spread: float
    seeds: int


def points(cells: Cells, quantity: Quantity, costs: Sequence[Cost]) -> tuple[Point, ...]:
    """Return all points, from short to long runs."""
    all_points = []
    for length in cells.lengths:
        runs = cells.at(length)
        for arm, by in standings(runs, quantity).items():
            for scene, standing in by.items():
                on_scene = [run for (at, _), run in runs[arm].items() if at == scene]
                amounts = {cost.name: [run.spent(cost) for run in on_scene] for cost in costs}
                spent = {
                    name: float(np.mean([amount for amount in values if amount is not None]))
                    for name, values in amounts.items()
                    if None not in values
                }
                text = on_scene[0].length_text
                all_points.append(
                    Point(arm, scene, text, spent, standing.mean, standing.spread, standing.seeds)
                )
    return tuple(all_points)


def gains(cells: Cells, quantity: Quantity) -> tuple[Contrast, ...]:
    """Compare the runs of each length with the next shorter runs of the same arm."""
    contrasts = []
    for arm in cells.runs:
        lengths = [length for length in cells.lengths if cells.at(length)[arm]]
        for shorter, longer in pairwise(lengths):
            if shorter[0] == longer[0]:
                contrasts.append(_gain(cells, quantity, arm, shorter, longer))
    return judged(contrasts)


def _gain(cells: Cells, quantity: Quantity, arm: str, shorter: Length, longer: Length) -> Contrast:
    names = f"{longer[1]:,g} {longer[0]}", f"{shorter[1]:,g} {shorter[0]}"
    runs = cells.at(longer)[arm], cells.at(shorter)[arm]
    return contrast(names, runs, quantity, lambda run: run.final(quantity.name), arm)

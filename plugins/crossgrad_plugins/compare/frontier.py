"""Final quality over the length of runs: what a longer run is worth."""

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
        length: Their budget as text.
        spent: Cost -> what they spent in the mean.
        mean: The figure at their ends in the mean.
        spread: Its standard deviation over seeds; NaN for one.
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
    """All points, from short to long."""
    found = []
    for length in cells.lengths:
        runs = cells.at(length)
        for arm, by in standings(runs, quantity).items():
            for scene, standing in by.items():
                own = [run for (at, _), run in runs[arm].items() if at == scene]
                amounts = {cost.name: [run.spent(cost) for run in own] for cost in costs}
                spent = {
                    name: float(np.mean([each for each in values if each is not None]))
                    for name, values in amounts.items()
                    if None not in values
                }
                text = own[0].length_text
                found.append(
                    Point(arm, scene, text, spent, standing.mean, standing.spread, standing.seeds)
                )
    return tuple(found)


def gains(cells: Cells, quantity: Quantity) -> tuple[Contrast, ...]:
    """Within each arm, runs of a length against those of the next shorter one."""
    found = []
    for arm in cells.runs:
        own = [length for length in cells.lengths if cells.at(length)[arm]]
        for shorter, longer in pairwise(own):
            if shorter[0] == longer[0]:
                found.append(_gain(cells, quantity, arm, shorter, longer))
    return judged(found)


def _gain(cells: Cells, quantity: Quantity, arm: str, shorter: Length, longer: Length) -> Contrast:
    names = f"{longer[1]:,g} {longer[0]}", f"{shorter[1]:,g} {shorter[0]}"
    runs = cells.at(longer)[arm], cells.at(shorter)[arm]
    return contrast(names, runs, quantity, lambda run: run.final(quantity.name), arm)

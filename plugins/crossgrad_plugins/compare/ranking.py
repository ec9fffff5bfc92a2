"""Arms from the best to the worst, and how much a seed changes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np

from crossgrad_plugins.compare.contrasts import Runs
from crossgrad_plugins.compare.quantity import Quantity


@dataclass(frozen=True)
class Standing:
    """An arm's figure at the end of its runs on one scene.

    Attributes:
        seeds: Number of runs that have the figure.
        mean: Its mean.
        spread: Its standard deviation over seeds; NaN for one.
    """

    seeds: int
    mean: float
    spread: float


def standings(
    runs: Mapping[str, Runs], quantity: Quantity, regime: str | None = None
) -> dict[str, dict[str, Standing]]:
    """Arm -> scene -> its figure; without scenes on which no run has it."""
    found: dict[str, dict[str, Standing]] = {}
    for arm, by in runs.items():
        own: dict[str, list[float]] = {}
        for (scene, _), run in by.items():
            value = run.final(quantity.name, regime)
            if value is not None:
                own.setdefault(scene, []).append(value)
        found[arm] = {scene: _standing(values) for scene, values in sorted(own.items())}
    return found


def _standing(values: Sequence[float]) -> Standing:
    spread = float(np.std(values, ddof=1)) if len(values) > 1 else float("nan")
    return Standing(len(values), float(np.mean(values)), spread)


def scores(standing: Mapping[str, Mapping[str, Standing]]) -> dict[str, float]:
    """Arm -> how far it is above the mean of all arms, in the mean over its scenes.

    So an arm that was not run on a hard scene gains nothing by that. NaN without a figure.
    """
    scenes = dict.fromkeys(scene for by in standing.values() for scene in by)
    level = {
        scene: float(np.mean([by[scene].mean for by in standing.values() if scene in by]))
        for scene in scenes
    }
    return {
        arm: float(np.mean([by[scene].mean - level[scene] for scene in by])) if by else float("nan")
        for arm, by in standing.items()
    }


def ranked(standing: Mapping[str, Mapping[str, Standing]], quantity: Quantity) -> tuple[str, ...]:
    """The arms from the best to the worst; arms without a figure at the end."""
    score = scores(standing)
    sign = 1.0 if quantity.falls else -1.0
    return tuple(sorted(score, key=lambda arm: (np.isnan(score[arm]), sign * score[arm])))


def noise(
    standing: Mapping[str, Mapping[str, Standing]], runs: Mapping[str, Runs]
) -> dict[str, tuple[float, int]]:
    """Scene -> standard deviation of a run over its seeds, pooled over arms, and its freedom.

    Scenes with one seed per arm are left out: there is no telling. Runs that stand for two arms
    count once.

    Args:
        standing: What `standings` finds.
        runs: The runs of each arm.
    """
    sums: dict[str, tuple[float, int]] = {}
    counted: set[frozenset[str]] = set()
    for arm, by in standing.items():
        for scene, each in by.items():
            own = frozenset(run.name for (at, _), run in runs[arm].items() if at == scene)
            if each.seeds > 1 and own not in counted:
                counted.add(own)
                total, freedom = sums.get(scene, (0.0, 0))
                more = each.seeds - 1
                sums[scene] = total + more * each.spread**2, freedom + more
    return {scene: (sqrt(total / freedom), freedom) for scene, (total, freedom) in sums.items()}

"""The ranking of arms, and the variation over seeds."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np

from crossgrad_plugins.compare.contrasts import Runs
from crossgrad_plugins.compare.quantity import Quantity


@dataclass(frozen=True)
class Standing:
    """The metric of an arm at the end of its runs on one scene.

    Attributes:
        seeds: Number of runs that have the metric.
        mean: Mean of the metric over runs.
        spread: Standard deviation over seeds; NaN for one run.
    """

    seeds: int
    mean: float
    spread: float


def standings(
    runs: Mapping[str, Runs], quantity: Quantity, regime: str | None = None
) -> dict[str, dict[str, Standing]]:
    """Return the metric by arm and scene, without scenes for which no run has the metric."""
    by_arm: dict[str, dict[str, Standing]] = {}
    for arm, by in runs.items():
        by_scene: dict[str, list[float]] = {}
        for (scene, _), run in by.items():
            value = run.final(quantity.name, regime)
            if value is not None:
                by_scene.setdefault(scene, []).append(value)
        by_arm[arm] = {scene: _standing(values) for scene, values in sorted(by_scene.items())}
    return by_arm


def _standing(values: Sequence[float]) -> Standing:
    spread = float(np.std(values, ddof=1)) if len(values) > 1 else float("nan")
    return Standing(len(values), float(np.mean(values)), spread)


def scores(standing: Mapping[str, Mapping[str, Standing]]) -> dict[str, float]:
    """Return each arm's mean difference from the mean of all arms, averaged over scenes.

    The difference is computed per scene, so that an arm does not gain by omitting a difficult
    scene. The result is NaN for an arm without a metric.
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
    """Return the arms from best to worst; arms without a metric are last."""
    score = scores(standing)
    sign = 1.0 if quantity.falls else -1.0
    return tuple(sorted(score, key=lambda arm: (np.isnan(score[arm]), sign * score[arm])))


def noise(
    standing: Mapping[str, Mapping[str, Standing]], runs: Mapping[str, Runs]
) -> dict[str, tuple[float, int]]:
    """Return the standard deviation over seeds and its degrees of freedom, by scene.

    The deviation is pooled over arms.

    Scenes with one seed per arm are left out, because they do not show the variation over seeds. A
    run that belongs to two arms counts once.

    Args:
        standing: Result of `standings`.
        runs: The runs of each arm.
    """
    sums: dict[str, tuple[float, int]] = {}
    counted: set[frozenset[str]] = set()
    for arm, by in standing.items():
        for scene, result in by.items():
            run_names = frozenset(run.name for (at, _), run in runs[arm].items() if at == scene)
            if result.seeds > 1 and run_names not in counted:
                counted.add(run_names)
                total, freedom = sums.get(scene, (0.0, 0))
                more = result.seeds - 1
                sums[scene] = total + more * result.spread**2, freedom + more
    return {scene: (sqrt(total / freedom), freedom) for scene, (total, freedom) in sums.items()}

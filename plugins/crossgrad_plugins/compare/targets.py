"""How soon a quality is reached, and the performance profile (Dolan and More 2002)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf, isfinite
from typing import Literal

import numpy as np

from crossgrad_plugins.compare.arms import Arm
from crossgrad_plugins.compare.cells import Problem
from crossgrad_plugins.compare.contrasts import Runs
from crossgrad_plugins.compare.cost import Cost
from crossgrad_plugins.compare.interpolate import cost_to
from crossgrad_plugins.compare.quantity import Quantity

#: The profile is drawn up to this ratio.
LARGEST_RATIO = 4.0


@dataclass(frozen=True)
class Reached:
    """How soon an arm reaches the quality of a scene.

    Attributes:
        cost: What is counted.
        scene: The scene.
        target: The quality.
        arm: The arm.
        amounts: Seed -> what was spent until then; infinite where it never was, or the run failed.
    """

    cost: Cost
    scene: str
    target: float
    arm: str
    amounts: Mapping[int, float]

    @property
    def reached(self) -> int:
        """Number of runs that got there."""
        return sum(isfinite(amount) for amount in self.amounts.values())

    @property
    def median(self) -> float:
        """The median over all runs, infinite where half of them never got there."""
        ordered = sorted(self.amounts.values())
        low, high = ordered[(len(ordered) - 1) // 2], ordered[len(ordered) // 2]
        return inf if high == inf else (low + high) / 2.0


def targets_of(
    runs: Mapping[str, Runs], quantity: Quantity, given: float | None
) -> dict[str, float]:
    """Scene -> the quality to reach: a given one, or where the weakest arm ends in its median.

    Of the two runs in the middle the worse one counts: where it ends, half of the runs and one
    more have been, so that the median of what they spent is finite.
    """
    finals: dict[str, dict[str, list[float]]] = {}
    for arm, by in runs.items():
        for (scene, _), run in by.items():
            value = run.final(quantity.name)
            if value is not None:
                finals.setdefault(scene, {}).setdefault(arm, []).append(value)
    worst = max if quantity.falls else min
    middle: Literal["higher", "lower"] = "higher" if quantity.falls else "lower"
    return {
        scene: given
        if given is not None
        else worst(float(np.quantile(values, 0.5, method=middle)) for values in by.values())
        for scene, by in sorted(finals.items())
    }


def reached(
    runs: Mapping[str, Runs],
    arms: Sequence[Arm],
    quantity: Quantity,
    cost: Cost,
    targets: Mapping[str, float],
) -> tuple[Reached, ...]:
    """How soon each arm reaches the quality of each scene; a failed run never does."""
    failed = {arm.name: {(run.scene, run.seed) for run in arm.failed} for arm in arms}
    rows = []
    for scene, target in targets.items():
        for arm, by in runs.items():
            never = {seed: inf for at, seed in failed[arm] if at == scene}
            found = {
                seed: cost_to(run, quantity, cost, target)
                for (at, seed), run in sorted(by.items())
                if at == scene
            }
            if amounts := {**never, **found}:
                rows.append(Reached(cost, scene, target, arm, amounts))
    return tuple(rows)


def ratios(rows: Sequence[Reached]) -> dict[str, list[float]]:
    """Arm -> what it spent on each problem, over the least that any arm spent.

    A problem is a scene with a seed that every arm was run on. A run that never gets there has an
    infinite ratio and stays in the denominator; so do all runs of a problem that no arm solves.
    """
    amounts: dict[str, dict[Problem, float]] = {}
    for row in rows:
        for seed, amount in row.amounts.items():
            amounts.setdefault(row.arm, {})[row.scene, seed] = amount
    shared = set.intersection(*(set(by) for by in amounts.values())) if amounts else set()
    least = {problem: min(by[problem] for by in amounts.values()) for problem in shared}
    return {
        arm: [_ratio(by[problem], least[problem]) for problem in sorted(shared)]
        for arm, by in amounts.items()
    }


def _ratio(amount: float, least: float) -> float:
    """An amount over the least one; 1 where both are nothing, as of a run that began there."""
    if isfinite(amount) and amount == least:
        return 1.0
    return amount / least if isfinite(amount) and least else inf

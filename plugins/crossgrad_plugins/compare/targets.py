"""The cost to reach a quality, and the performance profile (Dolan and More 2002)."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import inf, isfinite
from typing import Literal

import numpy as np

from crossgrad_plugins.compare.arms import Arm, Problem
from crossgrad_plugins.compare.contrasts import Runs
from crossgrad_plugins.compare.quantity import Cost, Quantity
from crossgrad_plugins.compare.run import Run

#: The performance profile is drawn up to this ratio.
LARGEST_RATIO = 4.0
#: Tolerance, as a share of an amount: a run that ends slightly before this amount still counts with
#: its last value. The tolerance is needed because a run with a time limit ends after a whole number
#: of steps.
_SAME_END = 0.03


@dataclass(frozen=True)
class Reached:
    """The cost at which an arm reaches the quality of a scene.

    Attributes:
        cost: The cost that is counted.
        scene: The scene.
        target: The quality.
        arm: The arm.
        amounts: Seed -> amount that was spent until the quality was reached; infinite if the run
            failed or never reached the quality.
    """

    cost: Cost
    scene: str
    target: float
    arm: str
    amounts: Mapping[int, float]

    @property
    def reached(self) -> int:
        """Number of runs that reached the quality."""
        return sum(isfinite(amount) for amount in self.amounts.values())

    @property
    def median(self) -> float:
        """The median amount over all runs; infinite if half of the runs never succeeded."""
        ordered = sorted(self.amounts.values())
        low, high = ordered[(len(ordered) - 1) // 2], ordered[len(ordered) // 2]
        return inf if high == inf else (low + high) / 2.0


def targets_of(
    runs: Mapping[str, Runs], quantity: Quantity, given: float | None
) -> dict[str, float]:
    """Return each scene's target: given, or the median final value of the weakest arm.

    If the number of runs is even, the worse of the two middle runs is used. More than half of the
    runs reach this quality, so the median of their costs is finite.
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
    """Return the cost at which each arm reaches each scene's quality; infinite for a failed run."""
    failed = {arm.name: {(run.scene, run.seed) for run in arm.failed} for arm in arms}
    rows = []
    for scene, target in targets.items():
        for arm, by in runs.items():
            never = {seed: inf for at, seed in failed[arm] if at == scene}
            by_seed = {
                seed: cost_to(run, quantity, cost, target)
                for (at, seed), run in sorted(by.items())
                if at == scene
            }
            if amounts := {**never, **by_seed}:
                rows.append(Reached(cost, scene, target, arm, amounts))
    return tuple(rows)


def ratios(rows: Sequence[Reached]) -> dict[str, list[float]]:
    """Return the cost of each arm on each problem, divided by the smallest cost of all arms.

    A problem is a scene and a seed for which every arm has a run. A run that never reaches the
    quality has an infinite ratio, and counts in the total. If no arm solves a problem, all its runs
    have an infinite ratio.
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
    """Return an amount divided by the least amount; 1 if both are equal, even if both are 0."""
    if isfinite(amount) and amount == least:
        return 1.0
    return amount / least if isfinite(amount) and least else inf


def value_at(run: Run, quantity: Quantity, cost: Cost, amount: float) -> float | None:
    """Return the metric at a cost, interpolated between two evaluations.

    Returns:
        The value; None before the first evaluation and after the end of the run.
    """
    x, y = run.series(quantity.name, cost)
    if not len(x) or amount < x[0] or amount > (1.0 + _SAME_END) * x[-1]:
        return None
    return float(np.interp(amount, x, y))


def shared_amount(runs: Iterable[Run], quantity: Quantity, cost: Cost) -> float | None:
    """Return the smallest final cost of all runs; None if a run has no evaluation."""
    ends = [x[-1] if len(x := run.series(quantity.name, cost)[0]) else None for run in runs]
    amounts = [float(end) for end in ends if end is not None]
    return min(amounts) if amounts and len(amounts) == len(ends) else None


def is_inside(run: Run, quantity: Quantity, cost: Cost, amount: float) -> bool:
    """Return True if the amount lies well before the end of the run."""
    x, _ = run.series(quantity.name, cost)
    return bool(len(x)) and amount < (1.0 - _SAME_END) * x[-1]


def cost_to(run: Run, quantity: Quantity, cost: Cost, target: float) -> float:
    """Return the cost at which a metric first reached the target; infinite if it never did."""
    x, y = run.series(quantity.name, cost)
    reached = y <= target if quantity.falls else y >= target
    if not reached.any():
        return inf
    first = int(np.argmax(reached))
    if first == 0:
        return float(x[0])
    before, after = y[first - 1], y[first]
    share = (target - before) / (after - before)
    return float(x[first - 1] + share * (x[first] - x[first - 1]))

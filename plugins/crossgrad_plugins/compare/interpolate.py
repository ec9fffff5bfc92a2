"""Reading a curve: its value at a cost, and the cost at which it reaches a value."""

from collections.abc import Iterable
from math import inf

import numpy as np

from crossgrad_plugins.compare.cost import Cost
from crossgrad_plugins.compare.quantity import Quantity
from crossgrad_plugins.compare.run import Run

#: A run may end so much earlier, relatively, and its last value still counts as the one there:
#: the length of a run that follows the clock is a whole number of steps.
_SAME_END = 0.03


def value_at(run: Run, quantity: Quantity, cost: Cost, amount: float) -> float | None:
    """The figure when so much was spent, between two evaluations by interpolation.

    Returns:
        The value; None before the first evaluation, and after the end.
    """
    x, y = run.series(quantity.name, cost)
    if not len(x) or amount < x[0] or amount > (1.0 + _SAME_END) * x[-1]:
        return None
    return float(np.interp(amount, x, y))


def shared_amount(runs: Iterable[Run], quantity: Quantity, cost: Cost) -> float | None:
    """What the run that spent least had spent at its last evaluation; None where one has none."""
    ends = [x[-1] if len(x := run.series(quantity.name, cost)[0]) else None for run in runs]
    known = [float(end) for end in ends if end is not None]
    return min(known) if known and len(known) == len(ends) else None


def is_inside(run: Run, quantity: Quantity, cost: Cost, amount: float) -> bool:
    """Whether the run went on well after that, so that its schedule was not at its end."""
    x, _ = run.series(quantity.name, cost)
    return bool(len(x)) and amount < (1.0 - _SAME_END) * x[-1]


def cost_to(run: Run, quantity: Quantity, cost: Cost, target: float) -> float:
    """What had been spent when a figure was first reached; infinite where it never was."""
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

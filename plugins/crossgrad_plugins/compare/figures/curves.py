"""Quality over what was spent, a panel for each scene, with bands over seeds."""

from collections.abc import Sequence
from math import ceil
from typing import TYPE_CHECKING

import numpy as np

from crossgrad_plugins.compare.comparison import Comparison
from crossgrad_plugins.compare.cost import Cost
from crossgrad_plugins.compare.figures.style import (
    PAGE,
    Drawn,
    Look,
    drawn,
    legend,
    literal,
    looks,
    new_figure,
    panel_title,
    styled,
)
from crossgrad_plugins.compare.quantity import Quantity
from crossgrad_plugins.compare.run import Array, Run

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_IN_A_ROW = 4
#: A line of so few points has markers; on others they would hide it.
_MOST_MARKERS = 4
#: Points of a line; seeds that are evaluated at other seconds would give too many.
_MOST_POINTS = 60
#: The first evaluations, far below the others, may be cut off: lower quantile that stays.
_KEPT = 0.22


def draw_curves(comparison: Comparison, cost: Cost) -> Drawn:
    """The curves of all arms over one cost."""
    scenes = comparison.scenes
    columns = min(_IN_A_ROW, len(scenes))
    rows = ceil(len(scenes) / columns)
    look = looks([arm.name for arm in comparison.arms])
    with styled():
        wide = PAGE if columns > 1 else PAGE * 0.62
        figure = new_figure(wide, 0.45 + 1.95 * rows)
        axes = figure.subplots(rows, columns, squeeze=False)
        for index, scene in enumerate(scenes):
            ax = axes.flat[index]
            _panel(ax, comparison, cost, scene, look)
            panel_title(ax, scene)
            if index % columns == 0:
                ax.set_ylabel(comparison.quantity.with_unit)
            if index + columns >= len(scenes):
                ax.set_xlabel(cost.axis)
        for ax in axes.flat[len(scenes) :]:
            ax.set_axis_off()
        legend(figure, axes.flat[0], list(look))
        return drawn(
            figure,
            f"curves_{cost.name}",
            f"{comparison.quantity.label} over {cost.title}",
            "Held-out views; lines are means over seeds, bands reach from the lowest to the "
            "highest seed. Seconds leave out compiling, loading and evaluating.",
        )


def _panel(
    ax: "Axes", comparison: Comparison, cost: Cost, scene: str, look: dict[str, Look]
) -> None:
    lows, highs = [], []
    for arm, by in comparison.main.items():
        runs = [run for (at, _), run in by.items() if at == scene]
        found = band(runs, comparison.quantity, cost)
        # An arm without a run on this scene still stands in the legend.
        x, low, middle, high = found if found is not None else (np.empty(0),) * 4
        marks = look[arm].marker if 0 < len(x) <= _MOST_MARKERS else ""
        ax.fill_between(x, low, high, color=look[arm].color, alpha=0.18, linewidth=0)
        ax.plot(
            x,
            middle,
            color=look[arm].color,
            linestyle=look[arm].dash,
            marker=marks,
            label=literal(arm),
        )
        if len(x):
            lows.append(np.quantile(low, _KEPT))
            highs.append(high.max())
    _limit(ax, lows, highs)
    ax.set_xlim(left=0.0)
    ax.locator_params(axis="x", nbins=5)


def _limit(ax: "Axes", lows: Sequence[float], highs: Sequence[float]) -> None:
    """Shows where the arms differ: the first, steep part of the curves would flatten the rest."""
    if lows and max(highs) > min(lows):
        room = 0.06 * (max(highs) - min(lows))
        ax.set_ylim(min(lows) - room, max(highs) + room)


def band(
    runs: Sequence[Run], quantity: Quantity, cost: Cost
) -> tuple[Array, Array, Array, Array] | None:
    """What was spent, and the lowest, mean and highest figure over seeds there.

    Between its evaluations a run's figure is interpolated; outside of what all runs have there is
    nothing.

    Returns:
        Four arrays [n]; None where no run has a curve.
    """
    series = [run.series(quantity.name, cost) for run in runs]
    known = [(x, y) for x, y in series if len(x)]
    if not known:
        return None
    first, last = max(x[0] for x, _ in known), min(x[-1] for x, _ in known)
    grid = np.unique(np.concatenate([x for x, _ in known]))
    grid = grid[(grid >= first) & (grid <= last)]
    if not len(grid):
        return None
    if len(grid) > _MOST_POINTS:
        grid = np.unique(np.append(np.linspace(first, last, _MOST_POINTS), last))
    values = np.stack([np.interp(grid, x, y) for x, y in known])
    return grid, values.min(axis=0), values.mean(axis=0), values.max(axis=0)

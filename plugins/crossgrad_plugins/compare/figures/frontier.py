"""The frontier: final quality over the length of the run."""

from math import ceil
from typing import TYPE_CHECKING

import numpy as np

from crossgrad_plugins.compare.comparison import Comparison
from crossgrad_plugins.compare.cost import Cost
from crossgrad_plugins.compare.figures.style import (
    PAGE,
    Drawn,
    drawn,
    legend,
    literal,
    looks,
    new_figure,
    panel_title,
    styled,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_IN_A_ROW = 4


def draw_frontier(comparison: Comparison, cost: Cost) -> Drawn | None:
    """Final quality over what whole runs spent; None where all runs have one length."""
    if not comparison.cells.several:
        return None
    scenes = comparison.scenes
    columns = min(_IN_A_ROW, len(scenes))
    rows = ceil(len(scenes) / columns)
    with styled():
        figure = new_figure(PAGE if columns > 1 else PAGE * 0.62, 0.45 + 1.95 * rows)
        axes = figure.subplots(rows, columns, squeeze=False)
        for index, scene in enumerate(scenes):
            _panel(axes.flat[index], comparison, cost, scene)
            if index % columns == 0:
                axes.flat[index].set_ylabel(f"final {comparison.quantity.with_unit}")
            if index + columns >= len(scenes):
                axes.flat[index].set_xlabel(f"{cost.axis}, whole run")
        for ax in axes.flat[len(scenes) :]:
            ax.set_axis_off()
        legend(figure, axes.flat[0], [arm.name for arm in comparison.arms])
        return drawn(
            figure,
            "frontier",
            "The frontier: final quality over the length of the run",
            "Each point is the end of runs of one length, their schedules stretched to it; error "
            "bars are standard deviations over seeds.",
        )


def _panel(ax: "Axes", comparison: Comparison, cost: Cost, scene: str) -> None:
    look = looks([arm.name for arm in comparison.arms])
    for arm in comparison.main:
        own = [p for p in comparison.points if (p.arm, p.scene) == (arm, scene)]
        own = sorted((p for p in own if cost.name in p.spent), key=lambda p: p.spent[cost.name])
        ax.errorbar(
            [point.spent[cost.name] for point in own],
            [point.mean for point in own],
            yerr=np.nan_to_num([point.spread for point in own]),
            color=look[arm].color,
            marker=look[arm].marker,
            linestyle=look[arm].dash,
            capsize=2.0,
            label=literal(arm),
        )
    panel_title(ax, scene)
    ax.set_xscale("log")
    _plain_ticks(ax)


def _plain_ticks(ax: "Axes") -> None:
    """Numbers as people write them: 300 and 600, not powers of ten."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator

    ax.xaxis.set_major_locator(LogLocator(base=10.0, subs=(1.0, 2.0, 5.0)))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,g}"))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.xaxis.set_minor_formatter(NullFormatter())

"""The grid of panels that all figures use, and drawing functions for panels."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import ceil
from typing import TYPE_CHECKING, Final

import numpy as np

from crossgrad_plugins.compare.comparison import Comparison
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
from crossgrad_plugins.compare.quantity import Cost, Quantity
from crossgrad_plugins.compare.run import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_IN_A_ROW: Final = 4
#: Width of a figure with one panel, as a share of the page width.
_SINGLE: Final = 0.62
#: A line with at most this many points gets markers. On longer lines, markers would hide the line.
_MOST_MARKERS: Final = 4
#: Maximum number of points of a line. Runs that were evaluated at different seconds would otherwise
#: give a line more points.
_MOST_POINTS: Final = 60


@dataclass(frozen=True)
class Grid:
    """A figure of panels side by side, at most four in a row.

    Attributes:
        name: Name of the figure, for files and ids.
        title: Title of the figure.
        caption: Description of the figure.
        y: Label of the vertical axes.
        x: Label of the horizontal axes, or one label per panel. The label is shown below the last
            panel of each column.
        height: Height of a row in inches.
        has_titles: True if each panel shows its name as title.
    """

    name: str
    title: str
    caption: str
    y: str
    x: str | Sequence[str] = ""
    height: float = 1.95
    has_titles: bool = True

    def draw(
        self, panels: Sequence[str], draw: Callable[["Axes", int], None], arms: Sequence[str]
    ) -> Drawn:
        """Draw the figure.

        Args:
            panels: The name of each panel.
            draw: Function that draws a panel, with the panel's index and axes as arguments.
            arms: The arms that the legend shows.
        """
        columns = min(_IN_A_ROW, len(panels))
        rows = ceil(len(panels) / columns)
        with styled():
            width = PAGE if columns > 1 else PAGE * _SINGLE
            figure = new_figure(width, 0.45 + self.height * rows)
            axes = figure.subplots(rows, columns, squeeze=False).flat
            for index, panel in enumerate(panels):
                draw(axes[index], index)
                if self.has_titles:
                    panel_title(axes[index], panel)
                if index % columns == 0:
                    axes[index].set_ylabel(self.y)
                if index + columns >= len(panels):
                    label = self.x if isinstance(self.x, str) else self.x[index]
                    axes[index].set_xlabel(label)
            for ax in axes[len(panels) :]:
                ax.set_axis_off()
            legend(figure, axes[0], arms)
            return drawn(figure, self.name, self.title, self.caption)

    def by_scene(self, c: Comparison, draw: Callable[["Axes", str], None]) -> Drawn:
        """Draw the figure with one panel for each scene."""
        arms = [arm.name for arm in c.arms]
        return self.draw(c.scenes, lambda ax, index: draw(ax, c.scenes[index]), arms)


def draw_bands(
    ax: "Axes",
    c: Comparison,
    scene: str,
    quantity: Quantity,
    cost: Cost,
    unit: float = 1.0,
) -> list[Array]:
    """Draw a line for each arm, with a band for the range over seeds.

    Args:
        ax: The panel.
        c: The comparison.
        scene: The scene.
        quantity: The metric on the vertical axis.
        cost: The cost on the horizontal axis.
        unit: Value that corresponds to 1 on the vertical axis, for example 1,000 primitives.

    Returns: The lowest [n] and the highest [n] metric of each arm that has a curve.
    """
    look = looks([arm.name for arm in c.arms])
    limits = []
    for arm in c.main:
        x, *values = band(c, arm, scene, quantity, cost)
        low, middle, high = (value / unit for value in values)
        color = look[arm].color
        marker = look[arm].marker if 0 < len(x) <= _MOST_MARKERS else ""
        ax.fill_between(x, low, high, color=color, alpha=0.18, linewidth=0)
        # An arm without a run on this scene also needs a legend entry.
        ax.plot(x, middle, color=color, linestyle=look[arm].dash, marker=marker, label=literal(arm))
        if len(x):
            limits += [low, high]
    ax.set_xlim(left=0.0)
    ax.locator_params(axis="x", nbins=5)
    return limits


def band(
    c: Comparison, arm: str, scene: str, quantity: Quantity, cost: Cost
) -> tuple[Array, Array, Array, Array]:
    """Return the costs, and the lowest, mean and highest metric over the seeds of an arm.

    The metric of a run is interpolated between its evaluations. The arrays [n] cover the costs that
    all runs of the arm have reached. The arrays are empty if no run has a curve, or if the runs
    have no common range of costs.
    """
    runs = [run for (at, _), run in c.main[arm].items() if at == scene]
    series = [(x, y) for x, y in (run.series(quantity.name, cost) for run in runs) if len(x)]
    first = max((x[0] for x, _ in series), default=0.0)
    last = min((x[-1] for x, _ in series), default=0.0)
    if not series or first > last:
        return (np.empty(0),) * 4
    grid = np.unique(np.concatenate([x for x, _ in series]))
    grid = grid[(grid >= first) & (grid <= last)]
    if len(grid) > _MOST_POINTS:
        grid = np.unique(np.append(np.linspace(first, last, _MOST_POINTS), last))
    values = np.stack([np.interp(grid, x, y) for x, y in series])
    return grid, values.min(axis=0), values.mean(axis=0), values.max(axis=0)

"""Primitives over the run: how large the models are, and when they grow."""

from math import ceil

import numpy as np

from crossgrad_plugins.compare.comparison import Comparison
from crossgrad_plugins.compare.cost import Cost
from crossgrad_plugins.compare.figures.curves import band
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
from crossgrad_plugins.compare.quantity import Quantity

_IN_A_ROW = 4
_COUNT = Quantity("primitives", "primitives", "", 0, 0.0)


def draw_primitives(comparison: Comparison, cost: Cost) -> Drawn:
    """The number of primitives of all arms over one cost, in thousands."""
    scenes = comparison.scenes
    columns = min(_IN_A_ROW, len(scenes))
    rows = ceil(len(scenes) / columns)
    look = looks([arm.name for arm in comparison.arms])
    with styled():
        figure = new_figure(PAGE if columns > 1 else PAGE * 0.62, 0.45 + 1.6 * rows)
        axes = figure.subplots(rows, columns, squeeze=False)
        for index, scene in enumerate(scenes):
            ax = axes.flat[index]
            for arm, by in comparison.main.items():
                runs = [run for (at, _), run in by.items() if at == scene]
                found = band(runs, _COUNT, cost)
                x, low, middle, high = found if found is not None else (np.empty(0),) * 4
                ax.fill_between(x, low / 1e3, high / 1e3, color=look[arm].color, alpha=0.18,
                                linewidth=0)  # fmt: skip
                ax.plot(x, middle / 1e3, color=look[arm].color, linestyle=look[arm].dash,
                        label=literal(arm))  # fmt: skip
            panel_title(ax, scene)
            ax.set_xlim(left=0.0)
            ax.set_ylim(bottom=0.0)
            ax.locator_params(axis="x", nbins=5)
            if index % columns == 0:
                ax.set_ylabel("thousand primitives")
            if index + columns >= len(scenes):
                ax.set_xlabel(cost.axis)
        for ax in axes.flat[len(scenes) :]:
            ax.set_axis_off()
        legend(figure, axes.flat[0], list(look))
        return drawn(
            figure,
            "primitives",
            "Primitives over the run",
            "At each evaluation; bands reach from the lowest to the highest seed.",
        )

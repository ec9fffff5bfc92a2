"""Each regime beside all views, by scene, with a sign for each seed."""

from math import ceil
from typing import TYPE_CHECKING

import numpy as np

from crossgrad_plugins.compare.comparison import OVERALL, Comparison
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
_SPREAD = 0.62


def draw_regimes(comparison: Comparison) -> Drawn:
    """The final figure of each arm, overall and by regime."""
    scenes = comparison.scenes
    columns = min(_IN_A_ROW, len(scenes))
    rows = ceil(len(scenes) / columns)
    look = looks([arm.name for arm in comparison.arms])
    with styled():
        wide = PAGE if columns > 1 else PAGE * 0.62
        figure = new_figure(wide, 0.45 + 1.75 * rows)
        axes = figure.subplots(rows, columns, squeeze=False)
        for index, scene in enumerate(scenes):
            ax = axes.flat[index]
            _panel(ax, comparison, scene)
            panel_title(ax, scene)
            if index % columns == 0:
                ax.set_ylabel(comparison.quantity.with_unit)
        for ax in axes.flat[len(scenes) :]:
            ax.set_axis_off()
        legend(figure, axes.flat[0], list(look))
        return drawn(
            figure,
            "regimes",
            "Each regime beside all views",
            "At the ends of the runs. A small sign is a run, the bar the mean over its seeds.",
        )


def _panel(ax: "Axes", comparison: Comparison, scene: str) -> None:
    look = looks([arm.name for arm in comparison.arms])
    name = comparison.quantity.name
    on_scene = [run for run in comparison.runs if run.scene == scene]
    regimes = list(dict.fromkeys(regime for run in on_scene for regime in run.results.regimes))
    groups: list[str | None] = [None, *(regimes if len(regimes) > 1 else [])]
    count = len(comparison.main)
    for index, (arm, by) in enumerate(comparison.main.items()):
        shift = 0.0 if count == 1 else _SPREAD * (index / (count - 1) - 0.5)
        runs = [run for (at, _), run in by.items() if at == scene]
        labelled = False
        for place, regime in enumerate(groups):
            values = [v for run in runs if (v := run.final(name, regime)) is not None]
            label = None if labelled else literal(arm)
            ax.plot([place + shift] * len(values), values, look[arm].marker, markersize=3.2,
                    color=look[arm].color, alpha=0.75, markeredgewidth=0, label=label)  # fmt: skip
            labelled = True
            if values:
                half = 0.4 * _SPREAD / max(1, count - 1)
                ax.plot([place + shift - half, place + shift + half], [np.mean(values)] * 2,
                        color=look[arm].color, linewidth=1.6)  # fmt: skip
    ax.set_xticks(range(len(groups)), [literal(group or OVERALL) for group in groups])
    ax.set_xlim(-0.6, len(groups) - 0.4)
    ax.grid(visible=False, axis="x")

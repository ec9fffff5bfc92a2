"""The performance profile: on which share of problems an arm is nearly the soonest."""

from typing import TYPE_CHECKING

import numpy as np

from crossgrad_plugins.compare.comparison import Comparison
from crossgrad_plugins.compare.figures.panels import Grid
from crossgrad_plugins.compare.figures.style import Drawn, literal, looks
from crossgrad_plugins.compare.targets import LARGEST_RATIO, ratios

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_POINTS = 301


def draw_profile(c: Comparison) -> Drawn | None:
    """Draw a panel for each cost; None with one arm, or if no problem is shared by all arms."""
    by_cost = {cost: ratios([row for row in c.reached if row.cost == cost]) for cost in c.costs}
    shown = {cost.title: by for cost, by in by_cost.items() if any(by.values())}
    if len(c.arms) < 2 or not shown:  # noqa: PLR2004 - nothing to compare
        return None
    look = looks([arm.name for arm in c.arms])
    at = np.linspace(1.0, LARGEST_RATIO, _POINTS)

    def panel(ax: "Axes", index: int) -> None:
        for arm, own in list(shown.values())[index].items():
            share = [np.mean(np.asarray(own) <= ratio + 1e-9) for ratio in at]
            ax.plot(at, share, color=look[arm].color, linestyle=look[arm].dash, label=literal(arm))
        ax.set_xlim(1.0, LARGEST_RATIO)
        ax.set_ylim(-0.02, 1.02)
        ax.tick_params(axis="y", labelleft=index == 0)

    problems = max(len(own) for by in shown.values() for own in by.values())
    return Grid(
        "profile",
        "Performance profile",
        f"Share of the {problems} problems (a scene with a seed) that an arm solves within this "
        "multiple of what the best arm needed. A run that never gets there stays in the "
        "denominator.",
        y="share of problems",
        x=[f"{title} to the quality,\nover the least of all arms" for title in shown],
        height=1.85,
        has_titles=False,
    ).draw(list(shown), panel, list(look))

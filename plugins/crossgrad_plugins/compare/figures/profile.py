"""The performance profile: on which share of problems an arm is nearly the soonest."""

import numpy as np

from crossgrad_plugins.compare.comparison import Comparison
from crossgrad_plugins.compare.figures.style import (
    COLUMN,
    PAGE,
    Drawn,
    drawn,
    legend,
    literal,
    looks,
    new_figure,
    styled,
)
from crossgrad_plugins.compare.targets import LARGEST_RATIO, ratios

_POINTS = 301


def draw_profile(comparison: Comparison) -> Drawn | None:
    """A panel for each cost; None with one arm, or where no problem is shared by all arms."""
    found = {
        cost: ratios([row for row in comparison.reached if row.cost == cost])
        for cost in comparison.costs
    }
    shown = {cost: by for cost, by in found.items() if any(by.values())}
    if len(comparison.arms) < 2 or not shown:  # noqa: PLR2004 - nothing to compare
        return None
    look = looks([arm.name for arm in comparison.arms])
    with styled():
        wide = COLUMN * 1.2 if len(shown) == 1 else PAGE
        figure = new_figure(wide, 2.3)
        axes = figure.subplots(1, len(shown), squeeze=False, sharey=True)
        at = np.linspace(1.0, LARGEST_RATIO, _POINTS)
        for ax, (cost, by) in zip(axes.flat, shown.items(), strict=True):
            for arm, own in by.items():
                share = [np.mean(np.asarray(own) <= ratio + 1e-9) for ratio in at]
                ax.plot(at, share, color=look[arm].color, linestyle=look[arm].dash,
                        label=literal(arm))  # fmt: skip
            ax.set_xlim(1.0, LARGEST_RATIO)
            ax.set_ylim(-0.02, 1.02)
            ax.set_xlabel(f"{cost.title} to the quality,\nover the least of all arms")
        axes.flat[0].set_ylabel("share of problems")
        legend(figure, axes.flat[0], list(look))
        count = max(len(own) for by in shown.values() for own in by.values())
        return drawn(
            figure,
            "profile",
            "Performance profile",
            f"Share of the {count} problems (a scene with a seed) that an arm solves within this "
            "multiple of what the best arm needed. A run that never gets there stays in the "
            "denominator.",
        )

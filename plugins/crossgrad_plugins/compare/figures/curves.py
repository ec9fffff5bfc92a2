"""Figures with one panel for each scene: curves, frontier, regimes, performance profile."""

from typing import TYPE_CHECKING, Final

import numpy as np

from crossgrad_plugins.compare.comparison import OVERALL, Comparison
from crossgrad_plugins.compare.figures.panels import Grid, draw_bands
from crossgrad_plugins.compare.figures.style import Drawn, literal, looks
from crossgrad_plugins.compare.quantity import Cost, Quantity
from crossgrad_plugins.compare.targets import LARGEST_RATIO, ratios

if TYPE_CHECKING:
    from matplotlib.axes import Axes


#: The vertical axis starts at this quantile of the values, because the first evaluations are much
#: lower.
_KEPT: Final = 0.22
_COUNT: Final = Quantity("primitives", "primitives", "", 0, 0.0)
#: Width over which the markers of all arms are spread, relative to the distance of two groups on
#: the axis.
_SPREAD: Final = 0.62
_POINTS = 301


def draw_curves(c: Comparison, cost: Cost) -> Drawn:
    """Draw the main metric of all arms against one cost."""

    def panel(ax: "Axes", scene: str) -> None:
        limits = draw_bands(ax, c, scene, c.quantity, cost)
        low = min((np.quantile(limit, _KEPT) for limit in limits[::2]), default=0.0)
        high = max((limit.max() for limit in limits[1::2]), default=0.0)
        if high > low:
            ax.set_ylim(low - 0.06 * (high - low), high + 0.06 * (high - low))

    return Grid(
        f"curves_{cost.name}",
        f"{c.quantity.label} over {cost.title}",
        "Held-out views. Lines are means over seeds, bands show the lowest and the "
        "highest seed. Seconds do not include compiling, loading and evaluating.",
        y=c.quantity.with_unit,
        x=cost.axis,
    ).by_scene(c, panel)


def draw_primitives(c: Comparison, cost: Cost) -> Drawn:
    """Draw the number of primitives of all arms, in thousands, against one cost."""

    def panel(ax: "Axes", scene: str) -> None:
        draw_bands(ax, c, scene, _COUNT, cost, 1e3)
        ax.set_ylim(bottom=0.0)

    return Grid(
        "primitives",
        "Gaussians during the run",
        "At each evaluation; bands show the lowest and the highest seed.",
        y="thousand primitives",
        x=cost.axis,
        height=1.6,
    ).by_scene(c, panel)


def draw_frontier(c: Comparison, cost: Cost) -> Drawn | None:
    """Draw final quality against the cost of whole runs.

    Return None if all runs have one length.
    """
    if not c.cells.several:
        return None
    look = looks([arm.name for arm in c.arms])

    def panel(ax: "Axes", scene: str) -> None:
        from matplotlib.ticker import LogLocator, NullLocator

        for arm in c.main:
            arm_points = [
                p for p in c.points if (p.arm, p.scene) == (arm, scene) and cost.name in p.spent
            ]
            arm_points = sorted(arm_points, key=lambda p: p.spent[cost.name])
            ax.errorbar(
                [point.spent[cost.name] for point in arm_points],
                [point.mean for point in arm_points],
                yerr=np.nan_to_num([point.spread for point in arm_points]),
                color=look[arm].color,
                marker=look[arm].marker,
                linestyle=look[arm].dash,
                capsize=2.0,
                label=literal(arm),
            )
        ax.set_xscale("log")
        # Show plain numbers such as 300 and 600, because powers of ten are harder to read.
        ax.xaxis.set_major_locator(LogLocator(base=10.0, subs=(1.0, 2.0, 5.0)))
        ax.xaxis.set_major_formatter("{x:,g}")
        ax.xaxis.set_minor_locator(NullLocator())

    return Grid(
        "frontier",
        "Final quality by the length of the run",
        "Each point is the end of the runs of one length, whose schedules are scaled "
        "to this length; error bars are standard deviations over seeds.",
        y=f"final {c.quantity.with_unit}",
        x=f"{cost.axis}, whole run",
    ).by_scene(c, panel)


def draw_regimes(c: Comparison) -> Drawn:
    """Draw the final metric of each arm, overall and by regime."""
    look = looks([arm.name for arm in c.arms])

    def panel(ax: "Axes", scene: str) -> None:
        on_scene = [run for run in c.runs if run.scene == scene]
        regimes = list(dict.fromkeys(regime for run in on_scene for regime in run.results.regimes))
        groups: list[str | None] = [None, *(regimes if len(regimes) > 1 else [])]
        gaps = max(1, len(c.main) - 1)
        for index, (arm, by) in enumerate(c.main.items()):
            shift = _SPREAD * (index / gaps - 0.5) if len(c.main) > 1 else 0.0
            runs = [run for (at, _), run in by.items() if at == scene]
            for position, regime in enumerate(groups):
                at = position + shift
                values = [v for run in runs if (v := run.final(c.quantity.name, regime))
                          is not None]  # fmt: skip
                ax.plot([at] * len(values), values, look[arm].marker, markersize=3.2,
                        color=look[arm].color, alpha=0.75, markeredgewidth=0,
                        label=None if regime else literal(arm))  # fmt: skip
                if values:
                    half = 0.4 * _SPREAD / gaps
                    ax.plot([at - half, at + half], [np.mean(values)] * 2,
                            color=look[arm].color, linewidth=1.6)  # fmt: skip
        ax.set_xticks(range(len(groups)), [literal(group or OVERALL) for group in groups])
        ax.set_xlim(-0.6, len(groups) - 0.4)
        ax.grid(visible=False, axis="x")

    return Grid(
        "regimes",
        "Each regime and all views",
        "At the end of the runs. A small marker is a run, the bar is the mean over its seeds.",
        y=c.quantity.with_unit,
        height=1.75,
    ).by_scene(c, panel)


def draw_profile(c: Comparison) -> Drawn | None:
    """Draw one panel for each cost; return None for a single arm or without common problems."""
    by_cost = {cost: ratios([row for row in c.reached if row.cost == cost]) for cost in c.costs}
    shown = {cost.title: by for cost, by in by_cost.items() if any(by.values())}
    if len(c.arms) < 2 or not shown:  # noqa: PLR2004 - nothing to compare
        return None
    look = looks([arm.name for arm in c.arms])
    at = np.linspace(1.0, LARGEST_RATIO, _POINTS)

    def panel(ax: "Axes", index: int) -> None:
        for arm, arm_ratios in list(shown.values())[index].items():
            share = [np.mean(np.asarray(arm_ratios) <= ratio + 1e-9) for ratio in at]
            ax.plot(at, share, color=look[arm].color, linestyle=look[arm].dash, label=literal(arm))
        ax.set_xlim(1.0, LARGEST_RATIO)
        ax.set_ylim(-0.02, 1.02)
        ax.tick_params(axis="y", labelleft=index == 0)

    problems = max(len(arm_ratios) for by in shown.values() for arm_ratios in by.values())
    return Grid(
        "profile",
        "Performance profile",
        f"Share of the {problems} problems (a scene with a seed) that an arm solves "
        "within this multiple of the cost of the best arm. A run that never reaches "
        "the quality counts as unsolved.",
        y="share of problems",
        x=[f"{title} until the quality,\nrelative to the best arm" for title in shown],
        height=1.85,
        has_titles=False,
    ).draw(list(shown), panel, list(look))

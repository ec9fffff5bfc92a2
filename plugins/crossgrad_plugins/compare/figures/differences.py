"""The figure of paired differences with their intervals and the margin."""

from collections.abc import Sequence
from itertools import groupby
from typing import TYPE_CHECKING, Final

from crossgrad_plugins.compare.comparison import OVERALL, Comparison
from crossgrad_plugins.compare.contrasts import Contrast
from crossgrad_plugins.compare.figures.style import (
    FAINT,
    INK,
    MARKERS,
    PAGE,
    Drawn,
    drawn,
    legend_above,
    literal,
    new_figure,
    styled,
    wrapped,
)
from crossgrad_plugins.compare.narrative import where_text
from crossgrad_plugins.compare.statistics import Verdict

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.lines import Line2D

#: Maximum number of rows that fit on a page.
_MOST_ROWS: Final = 24
#: Intervals are drawn above the middle of their row by this distance; the markers of pairs are
#: drawn below the middle.
_ABOVE: Final = 0.12
#: Number of characters per line of a heading, and height of a further line in rows.
_LETTERS, _LINE = 70, 0.6
_COLORS: Final = {
    Verdict.DIFFERENT: "#D55E00",
    Verdict.EQUIVALENT: "#009E73",
    Verdict.INCONCLUSIVE: "#666666",
}


def draw_differences(c: Comparison) -> Drawn | None:
    """Draw all contrasts of the main metric; return None for a single arm."""
    by_regime = (contrast for contrast in c.regimes if contrast.where != OVERALL)
    rows = [*c.ends, *c.equal, *by_regime][:_MOST_ROWS]
    if not rows:
        return None
    order = list(dict.fromkeys(map(_heading, rows)))
    rows.sort(key=lambda row: order.index(_heading(row)))
    margin = c.quantity.margin
    with styled():
        lines = sum(1.0 + _LINE * text.count("\n") for text in order)
        figure = new_figure(PAGE, 0.75 + 0.24 * (len(rows) + lines))
        ax = figure.subplots()
        ax.axvspan(-margin, margin, color=FAINT, alpha=0.13, linewidth=0)
        ax.axvline(0.0, color=FAINT, linewidth=0.8)
        # The range of the axis is given by the differences of the pairs. With two pairs, an
        # interval can be many dB wide.
        dots = [pair.difference for row in rows for pair in row.pairs]
        low, high = min([*dots, -2.0 * margin]), max([*dots, 2.0 * margin])
        ax.set_xlim(low - 0.1 * (high - low), high + 0.1 * (high - low))
        positions = _draw(ax, rows, c.scenes)
        ax.set_yticks(positions, [literal(where_text(row)) for row in rows])
        ax.set_ylim(positions[-1] + 0.6, -0.6)
        ax.grid(visible=False, axis="y")
        ax.tick_params(axis="y", length=0)
        ax.spines["left"].set_visible(False)
        ax.set_xlabel(f"difference in {c.quantity.with_unit}, first minus second arm")
        handles = _key(rows, c.scenes)
        legend_above(figure, handles, [str(handle.get_label()) for handle in handles], 6)
        return drawn(
            figure,
            "differences",
            "Paired differences",
            "Each small marker is a pair of runs on one scene with one seed. The thin "
            "bar is the 95 % interval, its thick part the 90 % interval, the large "
            "marker the estimate. An arrowhead means that the interval continues beyond "
            "the axis. The grey band is the margin of "
            f"{f'{margin:g} {c.quantity.unit}'.strip()}.",
        )


def _heading(row: Contrast) -> str:
    """Return the names of two arms, broken into several lines if needed."""
    return wrapped(literal(f"{row.first}  \u2212  {row.second}"), _LETTERS)


def _draw(ax: "Axes", rows: Sequence[Contrast], scenes: Sequence[str]) -> list[float]:
    """Draw the rows under the headings of their arms, and return the vertical positions."""
    positions: list[float] = []
    position = 0.0
    for heading, group in groupby(rows, _heading):
        position += _LINE * heading.count("\n")
        ax.text(0.0, position + 0.25, heading, fontweight="bold",
                transform=ax.get_yaxis_transform())  # fmt: skip
        for row in group:
            position += 1.0
            _row(ax, row, position, scenes)
            positions.append(position)
        position += 1.0
    return positions


def _row(ax: "Axes", row: Contrast, position: float, scenes: Sequence[str]) -> None:
    color, estimate = _COLORS[row.verdict], row.estimate
    for index, scene in enumerate(scenes):
        differences = [pair.difference for pair in row.pairs if pair.scene == scene]
        ax.plot(differences, [position + 0.2] * len(differences), MARKERS[index % len(MARKERS)],
                color=FAINT, alpha=0.55, markersize=2.4, markeredgewidth=0)  # fmt: skip
    if estimate is None:
        return
    above = position - _ABOVE
    if estimate.pairs > 1:
        ax.plot(estimate.wide, [above] * 2, color=color, linewidth=1.1)
        ax.plot(estimate.narrow, [above] * 2, color=color, linewidth=2.8)
        (first, last), (low, high) = estimate.wide, ax.get_xlim()
        for end, marker, is_cut in ((low, "<", first < low), (high, ">", last > high)):
            if is_cut:
                ax.plot([end], [above], marker, color=color, markersize=5, markeredgewidth=0,
                        clip_on=False)  # fmt: skip
    ax.plot([estimate.center], [above], "o", color=color, markersize=5, markeredgecolor=INK,
            markeredgewidth=0.5)  # fmt: skip


def _key(rows: Sequence[Contrast], scenes: Sequence[str]) -> list["Line2D"]:
    """Return the legend for colours and markers."""
    from matplotlib.lines import Line2D

    present = {row.verdict for row in rows}
    verdicts = [Line2D([], [], color=color, linewidth=2.8, label=str(verdict))
                for verdict, color in _COLORS.items() if verdict in present]  # fmt: skip
    return verdicts + [
        Line2D([], [], color=FAINT, linestyle="", marker=MARKERS[index % len(MARKERS)],
               markersize=3, label=literal(scene))
        for index, scene in enumerate(scenes)
    ]  # fmt: skip

"""Paired differences with their intervals, beside the margin."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

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
from crossgrad_plugins.compare.statistics.verdict import Verdict

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: More rows than these would not fit on a page.
MOST_ROWS = 24
#: How far intervals are above the middle of their row; the signs of pairs are below it.
_ABOVE = 0.12
#: Letters of a line of a heading, and the height of each further line in rows.
_LETTERS, _LINE = 70, 0.6
_COLORS = {
    Verdict.DIFFERENT: "#D55E00",
    Verdict.EQUIVALENT: "#009E73",
    Verdict.INCONCLUSIVE: "#666666",
}


def draw_differences(comparison: Comparison) -> Drawn | None:
    """All contrasts of the main figure; None with a single arm."""
    rows = [*comparison.ends, *comparison.equal, *_by_regime(comparison)][:MOST_ROWS]
    if not rows:
        return None
    rows = [row for arms in _headings(rows) for row in rows if _arms(row) == arms]
    scenes = comparison.scenes
    with styled():
        headings = [_heading(*arms) for arms in _headings(rows)]
        lines = sum(1.0 + _LINE * text.count("\n") for text in headings)
        figure = new_figure(PAGE, 0.75 + 0.24 * (len(rows) + lines))
        ax = figure.subplots()
        _margin(ax, comparison.quantity.margin)
        ticks = _draw(ax, rows, scenes)
        ax.set_yticks([place for place, _ in ticks], [text for _, text in ticks])
        ax.set_ylim(ticks[-1][0] + 0.6, -0.6)
        ax.grid(visible=False, axis="y")
        ax.tick_params(axis="y", length=0)
        ax.spines["left"].set_visible(False)
        ax.set_xlabel(f"difference in {comparison.quantity.with_unit}, first minus second arm")
        _key(figure, rows, scenes)
        _limit(ax, rows)
        _mark_cut(ax, rows, [place for place, _ in ticks])
        return drawn(
            figure,
            "differences",
            "Paired differences",
            "Each small sign is a pair of runs on one scene with one seed. The bar is the 95 % "
            "interval, its thick part the 90 % interval, the large sign the estimate; an "
            "arrowhead says that the interval goes on beyond the axis; the grey "
            f"band is the margin of {comparison.quantity.margin:g} "
            f"{comparison.quantity.unit}.".replace(" .", "."),
        )


def _by_regime(comparison: Comparison) -> list[Contrast]:
    return [each for each in comparison.regimes if each.where != OVERALL]


def _headings(rows: Sequence[Contrast]) -> list[tuple[str, str]]:
    return list(dict.fromkeys(map(_arms, rows)))


def _heading(first: str, second: str) -> str:
    """Return the names of two arms, on several lines if one line is too short for them."""
    return wrapped(literal(f"{first}  \u2212  {second}"), _LETTERS)


def _arms(row: Contrast) -> tuple[str, str]:
    return row.first, row.second


def _margin(ax: "Axes", margin: float) -> None:
    ax.axvspan(-margin, margin, color=FAINT, alpha=0.13, linewidth=0)
    ax.axvline(0.0, color=FAINT, linewidth=0.8)


def _draw(ax: "Axes", rows: Sequence[Contrast], scenes: Sequence[str]) -> list[tuple[float, str]]:
    """Draws the rows below headings; answers the labels of the axis with their places."""
    ticks: list[tuple[float, str]] = []
    place = 0.0
    for first, second in _headings(rows):
        text = _heading(first, second)
        place += _LINE * text.count("\n")
        ax.text(0.0, place + 0.25, text, fontweight="bold",
                transform=ax.get_yaxis_transform())  # fmt: skip
        place += 1.0
        for row in rows:
            if _arms(row) == (first, second):
                _row(ax, row, place, scenes)
                ticks.append((place, f"{literal(where_text(row))}"))
                place += 1.0
    return ticks


def _row(ax: "Axes", row: Contrast, place: float, scenes: Sequence[str]) -> None:
    color = _COLORS[row.verdict]
    for scene in scenes:
        own = [pair.difference for pair in row.pairs if pair.scene == scene]
        marker = MARKERS[scenes.index(scene) % len(MARKERS)]
        ax.plot(
            own, [place + 0.2] * len(own), marker, color=FAINT, alpha=0.55, markersize=2.4,
            markeredgewidth=0,
        )  # fmt: skip
    found = row.estimate
    if found is None:
        return
    if found.pairs > 1:
        ax.plot(found.wide, [place - _ABOVE] * 2, color=color, linewidth=1.1)
        ax.plot(found.narrow, [place - _ABOVE] * 2, color=color, linewidth=2.8)
    ax.plot([found.center], [place - _ABOVE], "o", color=color, markersize=5, markeredgecolor=INK,
            markeredgewidth=0.5)  # fmt: skip


def _mark_cut(ax: "Axes", rows: Sequence[Contrast], places: Sequence[float]) -> None:
    """Draw an arrowhead where an interval goes on beyond the axis."""
    low, high = ax.get_xlim()
    for row, place in zip(rows, places, strict=True):
        if row.estimate is None or row.estimate.pairs == 1:
            continue
        first, last = row.estimate.wide
        for end, marker, is_cut in ((low, "<", first < low), (high, ">", last > high)):
            if is_cut:
                ax.plot([end], [place - _ABOVE], marker, color=_COLORS[row.verdict],
                        markersize=5, markeredgewidth=0, clip_on=False)  # fmt: skip


def _key(figure: "Figure", rows: Sequence[Contrast], scenes: Sequence[str]) -> None:
    """Put what colours and signs mean above the panel."""
    from matplotlib.lines import Line2D

    present = [verdict for verdict in Verdict if any(row.verdict == verdict for row in rows)]
    handles = [Line2D([], [], color=_COLORS[v], linewidth=2.8, label=str(v)) for v in present]
    handles += [
        Line2D([], [], color=FAINT, linestyle="", marker=MARKERS[index % len(MARKERS)],
               markersize=3, label=literal(scene))
        for index, scene in enumerate(scenes)
    ]  # fmt: skip
    labels = [str(handle.get_label()) for handle in handles]
    legend_above(figure, handles, labels, 6)


def _limit(ax: "Axes", rows: Sequence[Contrast]) -> None:
    """A row of two pairs has an interval of many dB; it runs out of the figure."""
    dots = [pair.difference for row in rows for pair in row.pairs]
    margin = rows[0].quantity.margin
    low, high = min([*dots, -2.0 * margin]), max([*dots, 2.0 * margin])
    room = 0.1 * (high - low)
    ax.set_xlim(low - room, high + room)

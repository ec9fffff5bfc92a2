"""curve.png: PSNR and SSIM of the held-out views against training seconds."""

import io
from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from crossgrad_core.run.results.metrics_csv import Row
from crossgrad_core.system.files import write_atomically
from crossgrad_core.wording import one_line

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FILE = "curve.png"
_OVERALL = "overall"

#: Okabe and Ito's colours, which people with any type of colour vision can distinguish. Black is
#: used for `overall` only.
_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
_MARKERS = ("s", "^", "D", "v", "P", "X")
_STYLES = ("--", "-.", ":")
#: Maximum number of points with markers. With more points, markers would hide the line.
_MOST_MARKERS = 25
_LONGEST_IN_TWO_COLUMNS = 48  # in characters of a legend entry


class _Line(NamedTuple):
    """One line of a chart: its label and its style."""

    label: str
    column: str
    color: str = "black"
    marker: str = "o"
    style: str = "-"


def draw_curve(
    folder: Path, rows: Sequence[Row], title: str, views: Mapping[str, int] | None = None
) -> Path:
    """Draw curve.png; without held-out views, the curve shows the training loss.

    Args:
        folder: The run's folder.
        rows: Rows of metrics.csv.
        title: Title of the chart.
        views: Number of held-out views of each regime, and of all views under "overall". If None,
            the chart contains no lines for regimes.

    Returns:
        The file.

    Raises:
        UserError: The disk is full.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    scored = any(row.get("psnr") is not None for row in rows)
    charts = [("psnr", "PSNR (dB)"), ("ssim", "SSIM")] if scored else [("loss", "training loss")]
    layout = ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.07)  # inches
    figure = Figure(figsize=(7.5, 2.2 + 2.6 * len(charts)), dpi=150, layout=layout)
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(charts), 1, sharex=True, squeeze=False)[:, 0]
    lines = _lines(rows, views or {}) if scored else [_Line("mean over the views of the step", "")]
    for ax, (metric, label) in zip(axes, charts, strict=True):
        _draw(ax, rows, metric, lines)
        ax.set_ylabel(label)
    axes[0].set_xlim(left=0.0)
    axes[-1].set_xlabel("training seconds (without compiling, loading and evaluating)")
    _add_view_axis(axes[0], rows)
    _add_legend(figure, axes[0])
    figure.suptitle(_literal(title), fontsize=11)
    return _saved(figure, folder / FILE)


def _lines(rows: Sequence[Row], views: Mapping[str, int]) -> list[_Line]:
    lines = [_Line(_labelled(_OVERALL, "", rows[-1], views), "")]
    regimes = [name for name in sorted(views) if name != _OVERALL and f"psnr_{name}" in rows[0]]
    looks = zip(cycle(_COLORS), cycle(_MARKERS), cycle(_STYLES), strict=False)
    if len(regimes) > 1:  # The curve of a single regime is equal to the curve `overall`.
        for name, look in zip(regimes, looks, strict=False):
            lines.append(_Line(_labelled(name, f"_{name}", rows[-1], views), f"_{name}", *look))
    return lines


def _labelled(name: str, column: str, last: Row, views: Mapping[str, int]) -> str:
    """Return the label of a regime: its name, number of views, final PSNR and final SSIM."""
    count = views.get(name)
    label = _literal(name)
    if count is not None:
        label += f" ({count} view{'s' if count != 1 else ''})"
    psnr, ssim = last.get(f"psnr{column}"), last.get(f"ssim{column}")
    return label if psnr is None or ssim is None else f"{label}: {psnr:.2f} dB, {ssim:.3f}"


def _literal(text: str) -> str:
    """Return text that matplotlib shows literally: no label is hidden and no formula is drawn."""
    text = one_line(text).replace("$", r"\$")
    return f"'{text}'" if text.startswith("_") else text


def _draw(ax: "Axes", rows: Sequence[Row], metric: str, lines: Sequence[_Line]) -> None:
    for line in reversed(lines):  # Draw `overall` on top.
        points = [(row["train_seconds"], row.get(f"{metric}{line.column}")) for row in rows]
        measured = [(x, y) for x, y in points if x is not None and y is not None and np.isfinite(y)]
        ax.plot(
            [x for x, _ in measured],
            [y for _, y in measured],
            label=line.label,
            color=line.color,
            marker=line.marker if len(measured) <= _MOST_MARKERS else "",
            linestyle=line.style,
            linewidth=2.0 if line.column == "" else 1.5,
            markersize=4.5,
        )
    ax.grid(color="0.9", linewidth=0.8)
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)
    ax.margins(x=0.03, y=0.1)


def _add_view_axis(ax: "Axes", rows: Sequence[Row]) -> None:
    """Add a second axis above the chart with round numbers of rendered views."""
    from matplotlib.ticker import MaxNLocator

    counted = [(row["train_seconds"], row["views"]) for row in rows]
    pairs = [
        (0.0, 0.0),
        *((x, count) for x, count in counted if x is not None and count is not None),
    ]
    seconds, views = np.array(pairs, dtype=np.float64).T
    ticks = np.asarray(MaxNLocator(6, integer=True).tick_values(0.0, views[-1]))
    ticks = ticks[(ticks >= 0.0) & (ticks <= views[-1])]
    above = ax.secondary_xaxis("top")
    above.set_xticks(np.interp(ticks, views, seconds), [f"{tick:,.0f}" for tick in ticks])
    above.set_xlabel("rendered training views", color="0.35")
    above.tick_params(colors="0.35")
    above.spines["top"].set_color("0.7")


def _add_legend(figure: "Figure", ax: "Axes") -> None:
    handles, labels = ax.get_legend_handles_labels()
    figure.legend(
        handles[::-1],
        labels[::-1],
        loc="outside lower left",
        ncols=2 if max(map(len, labels)) <= _LONGEST_IN_TWO_COLUMNS else 1,
        fontsize=9,
        frameon=False,
        handlelength=3.0,
    )


def _saved(figure: "Figure", path: Path) -> Path:
    picture = io.BytesIO()
    figure.savefig(picture, format="png")
    write_atomically(path, picture.getvalue())
    return path

"""The pictures of a report: six panels, and the exposure of a scene's photos."""

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from crossgrad_plugins.diagnostics.exposure import SceneExposure
from crossgrad_plugins.diagnostics.table import ALL, AMPLITUDES, Row, rows_of, touched
from crossgrad_plugins.exposures.tracks.gains import LEAST_REDUCTION, LEAST_SPREAD

if TYPE_CHECKING:
    from matplotlib.axes import Axes


#: Okabe and Ito's colours, distinguishable with any colour vision.
_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
_METRICS = {"plain": ("o", "#0072B2"), "adam": ("s", "#D55E00")}
#: Okabe and Ito's colours, distinguishable with any colour vision.
_EXPOSURE_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
_BLACK = "#000000"
#: Maximum number of photos whose names are written below the axis.
_MOST_NAMES = 60


def draw(title: str, probes: Sequence[Row], cameras: Sequence[Row]) -> bytes:
    """Draw the figure of all probes as PNG.

    Args:
        title: Title of the picture.
        probes: Table rows of all probes; panels without a time axis show the last probe.
        cameras: Rows of `camera_rows`.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 8.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 3)
    figure.suptitle(title)
    last = max(int(row["step"]) for row in probes)
    shown = touched(probes)
    now = [row for row in shown if row["step"] == last]
    _trajectory(axes[0, 0], shown, "conflict_rate", "conflict rate (near, far)")
    axes[0, 0].set_ylim(-0.02, 1.02)
    _trajectory(axes[0, 1], shown, "ratio_of_means", "gradient length, near / far")
    axes[0, 1].set_yscale("log")
    axes[0, 1].axhline(1.0, color="0.6", linewidth=0.8)
    _intervals(axes[0, 2], now, "rho", f"sigma_b^2 / sigma_w^2, step {last}, 95 %")
    _intervals(axes[1, 0], now, "exponent_radial", f"distance exponent, step {last}, 95 %")
    axes[1, 0].axhline(0.0, color="0.6", linewidth=0.8)
    _by_distance(axes[1, 1], now)
    _bimodality(axes[1, 2], cameras)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()


def _legend(axes: "Axes") -> None:
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=8)


def _blocks(rows: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys(str(row["block"]) for row in rows))


def _trajectory(axes: "Axes", probes: Sequence[Row], column: str, label: str) -> None:
    """Draw one line per block over the steps, in the plain metric."""
    rows = rows_of(probes, "plain")
    singles = [b for b in _blocks(rows) if b not in {ALL, "+".join(AMPLITUDES)}]
    for number, block in enumerate(singles):
        block_rows = [row for row in rows if row["block"] == block]
        steps = [float(row["step"]) for row in block_rows]
        values = [float(row[column]) for row in block_rows]
        color = _COLORS[number % len(_COLORS)]
        axes.plot(steps, values, marker="o", markersize=4, color=color, label=block)
    axes.set_xlabel("step")
    axes.set_ylabel(label)
    _legend(axes)


def _intervals(axes: "Axes", rows: Sequence[Row], column: str, label: str) -> None:
    """Draw a point with its interval for each block; the two metrics are side by side."""
    blocks = _blocks(rows)
    for shift, (metric, (marker, color)) in zip((-0.12, 0.12), _METRICS.items(), strict=True):
        by_block = {str(row["block"]): row for row in rows_of(rows, metric)}
        if not by_block:
            continue
        places = np.arange(len(blocks)) + shift
        values, low, high = (
            np.array([float(by_block[block][column + end]) for block in blocks])
            for end in ("", "_low", "_high")
        )
        axes.vlines(places, low, _drawable(high, low), color=color, linewidth=1.5)
        axes.plot(places, values, marker, color=color, label=f"{metric} metric")
    axes.set_xticks(range(len(blocks)), blocks, rotation=30, ha="right", fontsize=8)
    axes.set_ylabel(label)
    _legend(axes)


def _drawable(high: NDArray[np.float64], low: NDArray[np.float64]) -> NDArray[np.float64]:
    """Replace infinite upper ends of intervals by a value slightly above the largest finite end."""
    finite = high[np.isfinite(high)]
    top = 1.2 * float(finite.max()) if len(finite) else float(np.nanmax(np.append(low, 1.0)))
    return np.where(np.isinf(high), top, high)


def _by_distance(axes: "Axes", rows: Sequence[Row]) -> None:
    """Draw one line per block: conflict of pairs of views by their difference in distance."""
    plain = rows_of(rows, "plain")
    singles = [row for row in plain if row["block"] not in {ALL, "+".join(AMPLITUDES)}]
    for number, row in enumerate(singles):
        bins = [name for name in row if name.startswith("conflict_radial_bin")]
        rates = [float(row[name]) for name in bins]
        color = _COLORS[number % len(_COLORS)]
        axes.plot(range(1, len(bins) + 1), rates, marker="o", color=color, label=str(row["block"]))
        axes.set_xticks(range(1, len(bins) + 1))
    axes.set_ylim(-0.02, 1.02)
    axes.set_xlabel("quarter of pairs by |log r_i - log r_j|, small to large")
    axes.set_ylabel("conflict rate (all pairs of views)")
    _legend(axes)


def _bimodality(axes: "Axes", cameras: Sequence[Row]) -> None:
    """Draw both forms of Sarle's bimodality coefficient."""
    names = [str(row["quantity"]).split(" (")[0] for row in cameras]
    places = np.arange(len(names))
    for shift, column, color in ((-0.2, "sample", _COLORS[0]), (0.2, "population", _COLORS[1])):
        values = [float(row[f"bimodality_{column}"]) for row in cameras]
        axes.bar(places + shift, values, 0.38, color=color, label=f"{column} form")
    for value, label in ((5.0 / 9.0, "uniform"), (1.0 / 3.0, "normal")):
        axes.axhline(value, color="0.4", linewidth=0.8, linestyle=":")
        axes.annotate(label, (-0.45, value), fontsize=7, va="bottom")
    count = int(cameras[0]["views"]) if cameras else 0
    axes.set_ylim(0.0, 1.05)
    axes.set_xticks(places, names, fontsize=8)
    axes.set_ylabel(f"Sarle's bimodality, n = {count}")
    _legend(axes)


def draw_exposure(title: str, exposure: SceneExposure) -> bytes:
    """Draw the figure of the exposure as PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 5), layout="constrained")
    FigureCanvasAgg(figure)
    photos, explained = figure.subplots(1, 2, width_ratios=(3, 1))
    figure.suptitle(title)
    _draw_gains(photos, exposure)
    _draw_rule(explained, exposure)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()


def _draw_gains(axes: "Axes", exposure: SceneExposure) -> None:
    """Draw a bar for each photo and a marker for each EXIF value.

    Bars of held-out photos are hatched.
    """
    rows = exposure.rows
    places = np.arange(len(rows))
    gains, exif = (np.array([float(r[k]) for r in rows]) for k in ("gain_stops", "exif_stops"))
    regimes = np.array([str(row["regime"]) for row in rows])
    for number, regime in enumerate(sorted(set(regimes))):
        in_regime = regimes == regime
        color = _EXPOSURE_COLORS[number % len(_EXPOSURE_COLORS)]
        axes.bar(places[in_regime], np.nan_to_num(gains[in_regime]), 0.8, color=color, label=regime)
    held_out = np.array([row["part"] == "test" for row in rows])
    if held_out.any():
        heights = np.nan_to_num(gains[held_out])
        axes.bar(places[held_out], heights, 0.8, fill=False, hatch="///", label="held out")
    if not np.isnan(exif).all():
        axes.plot(places, exif, "D", color=_BLACK, markersize=4, label="EXIF")
    axes.axhline(0.0, color="0.4", linewidth=0.8)
    axes.set_ylabel("stops above the mean")
    if len(rows) <= _MOST_NAMES:
        axes.set_xticks(places, [str(row["photo"]) for row in rows], rotation=90, fontsize=6)
    else:
        axes.set_xlabel("photos by name")
    axes.legend(fontsize=8)


def _draw_rule(axes: "Axes", exposure: SceneExposure) -> None:
    """Draw the values that the exposure rule compares, and the threshold of each value."""
    values = (exposure.spread, exposure.before, exposure.after)
    limits = (LEAST_SPREAD, np.nan, (1.0 - LEAST_REDUCTION) * exposure.before)
    axes.bar(range(3), values, 0.6, color=(_EXPOSURE_COLORS[0], "0.6", _EXPOSURE_COLORS[2]))
    for position, limit in enumerate(limits):
        axes.plot([position - 0.4, position + 0.4], [limit, limit], color=_BLACK, linewidth=1.5)
    names = ("gains\n(above the line)", "observations", "gains removed\n(below the line)")
    axes.set_xticks(range(3), names, fontsize=7)
    axes.set_ylabel("deviation, stops")
    axes.set_title("photos differ" if exposure.differ else "photos agree", fontsize=10)

"""The picture of a scene's exposure: the gain of each photo, and what the gains explain."""

import io
from typing import TYPE_CHECKING

import numpy as np

from crossgrad_plugins.diagnostics.exposure import SceneExposure
from crossgrad_plugins.exposures.tracks.gains import LEAST_REDUCTION, LEAST_SPREAD

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: Okabe and Ito's colours, distinguishable with any colour vision.
_COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
_BLACK = "#000000"
#: Names of more photos do not fit below the axis.
_MOST_NAMES = 60


def draw_exposure(title: str, exposure: SceneExposure) -> bytes:
    """The picture as PNG."""
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
    """A bar for each photo, held-out ones hatched, and EXIF as marks."""
    rows = exposure.rows
    places = np.arange(len(rows))
    gains, told = (np.array([float(r[k]) for r in rows]) for k in ("gain_stops", "exif_stops"))
    regimes = np.array([str(row["regime"]) for row in rows])
    for number, regime in enumerate(sorted(set(regimes))):
        own = regimes == regime
        color = _COLORS[number % len(_COLORS)]
        axes.bar(places[own], np.nan_to_num(gains[own]), 0.8, color=color, label=regime)
    held_out = np.array([row["part"] == "test" for row in rows])
    if held_out.any():
        heights = np.nan_to_num(gains[held_out])
        axes.bar(places[held_out], heights, 0.8, fill=False, hatch="///", label="held out")
    if not np.isnan(told).all():
        axes.plot(places, told, "D", color=_BLACK, markersize=4, label="EXIF")
    axes.axhline(0.0, color="0.4", linewidth=0.8)
    axes.set_ylabel("stops above the mean")
    if len(rows) <= _MOST_NAMES:
        axes.set_xticks(places, [str(row["photo"]) for row in rows], rotation=90, fontsize=6)
    else:
        axes.set_xlabel("photos by name")
    axes.legend(fontsize=8)


def _draw_rule(axes: "Axes", exposure: SceneExposure) -> None:
    """What the rule compares with what, each beside its threshold."""
    values = (exposure.spread, exposure.before, exposure.after)
    limits = (LEAST_SPREAD, np.nan, (1.0 - LEAST_REDUCTION) * exposure.before)
    axes.bar(range(3), values, 0.6, color=(_COLORS[0], "0.6", _COLORS[2]))
    for place, limit in enumerate(limits):
        axes.plot([place - 0.4, place + 0.4], [limit, limit], color=_BLACK, linewidth=1.5)
    names = ("gains\n(above the line)", "observations", "gains taken out\n(below the line)")
    axes.set_xticks(range(3), names, fontsize=7)
    axes.set_ylabel("deviation, stops")
    axes.set_title("photos differ" if exposure.differ else "photos agree", fontsize=10)

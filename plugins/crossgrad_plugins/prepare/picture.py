"""The picture of a prepared scene: its cameras from two sides, and what joins them."""

import io
from collections.abc import Mapping
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from crossgrad_plugins.prepare.georegister import centers_of
from crossgrad_plugins.prepare.report import Report

if TYPE_CHECKING:
    import pycolmap
    from matplotlib.axes import Axes

#: Okabe and Ito's colours, distinguishable with any colour vision.
_COLORS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7A5C00")
_MOST_POINTS, _MOST_LINKS = 20_000, 4_000
#: Points beyond these percentiles are not in the picture.
_INNER: Final = (1.0, 99.0)
_MARGIN: Final = 0.15
#: Titles of both panels of a scene without a place on Earth, and so without a direction up.
_TITLES: Final = ("first and second axis of the cameras", "first and third axis of the cameras")


def draw(report: Report, model: "pycolmap.Reconstruction") -> bytes:
    """The picture as PNG.

    Args:
        report: What is known of the scene.
        model: Its model.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    on_earth = report.result.georef is not None
    centers = centers_of(model)
    points: NDArray[np.float64] = np.array([point.xyz for point in model.points3D.values()])
    points = points.reshape(-1, 3)[:: max(1, len(points) // _MOST_POINTS)]
    axes_of_plane = np.eye(3) if on_earth else _axes(np.array(list(centers.values())))
    flat = {name: axes_of_plane @ center for name, center in centers.items()}
    figure = Figure(figsize=(13, 6.5), layout="constrained")
    FigureCanvasAgg(figure)
    first, second = figure.subplots(1, 2)
    unit = "m" if on_earth else "units of the scene"
    for axes, (across, up) in ((first, (0, 1)), (second, (0, 2))):
        _panel(axes, report, points @ axes_of_plane.T, flat, (across, up))
    names = ("east", "north", "up") if on_earth else ("first axis", "second axis", "third axis")
    titles = ("from above", "from the side") if on_earth else _TITLES
    first.set(title=titles[0], xlabel=f"{names[0]}, {unit}", ylabel=f"{names[1]}, {unit}")
    second.set(title=titles[1], xlabel=f"{names[0]}, {unit}", ylabel=f"{names[2]}, {unit}")
    first.legend(fontsize=8, loc="upper right")
    posed, used = len(report.posed), len(report.plan.used)
    figure.suptitle(f"{posed} of {used} photos, and their pairs with verified matches")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()


def _panel(
    axes: "Axes",
    report: Report,
    points: NDArray[np.float64],
    centers: Mapping[str, NDArray[np.float64]],
    shown: tuple[int, int],
) -> None:
    """One view of points, links and cameras, along two of the axes."""
    from matplotlib.collections import LineCollection

    across, up = shown
    axes.scatter(points[:, across], points[:, up], s=0.3, color="0.75", zorder=0, rasterized=True)
    links = [link for link in report.links if link.first in centers and link.second in centers]
    links = sorted(links, key=lambda link: -link.matches)[:_MOST_LINKS]
    ends = [
        (centers[link.first][[across, up]], centers[link.second][[across, up]]) for link in links
    ]
    widths = [0.2 + 1.3 * min(1.0, link.matches / 500.0) for link in links]
    axes.add_collection(LineCollection(ends, colors="0.35", linewidths=widths, alpha=0.25))
    folders = {photo.name: photo.folder for photo in report.plan.used}
    for number, folder in enumerate(report.plan.folders):
        at = np.array([centers[name] for name in sorted(centers) if folders[name] == folder])
        if len(at):
            axes.scatter(at[:, across], at[:, up], s=18, zorder=3, linewidths=0.4, edgecolors="w",
                         color=_COLORS[number % len(_COLORS)],
                         label=f"{folder or 'photos'} ({len(at)})")  # fmt: skip
    axes.set_aspect("equal", adjustable="box")
    _limits(axes, points[:, [across, up]], np.array(list(centers.values()))[:, [across, up]])


def _limits(axes: "Axes", points: NDArray[np.float64], cameras: NDArray[np.float64]) -> None:
    """Shows all cameras and most points."""
    inner = np.percentile(points, _INNER, axis=0) if len(points) else cameras
    corners = np.vstack([inner, cameras])
    low, high = corners.min(0), corners.max(0)
    margin = _MARGIN * max(float((high - low).max()), 1e-9)
    axes.set_xlim(low[0] - margin, high[0] + margin)
    axes.set_ylim(low[1] - margin, high[1] + margin)


def _axes(centers: NDArray[np.float64]) -> NDArray[np.float64]:
    """[3, 3] rows: the two directions in which the cameras lie farthest apart, and the third."""
    return np.asarray(np.linalg.svd(centers - centers.mean(0), full_matrices=True)[2])

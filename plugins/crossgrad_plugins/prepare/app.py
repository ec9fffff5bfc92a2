"""The stages that make a scene from photos. Each stage can continue after an interruption."""

import io
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.commands import (
    Progress,
    UserError,
    accepts,
    available_cores,
    disk_errors,
    entries,
    locked,
    one_line,
    resume_hint,
    text_bytes,
    write_atomically,
)
from crossgrad_core.scene.pycolmap_guard import guard_pycolmap
from crossgrad_plugins.planner.app import advised
from crossgrad_plugins.prepare import mapping, matching
from crossgrad_plugins.prepare.features import found_features
from crossgrad_plugins.prepare.georegister import centers_of
from crossgrad_plugins.prepare.layout import Layout, check_ours, clear_damaged, clear_leftovers
from crossgrad_plugins.prepare.photos import find_photos, has_photos
from crossgrad_plugins.prepare.plan import Plan, Settings, agreed
from crossgrad_plugins.prepare.report import Report, data_of, page_of, summary_lines
from crossgrad_plugins.prepare.results import placed
from crossgrad_plugins.prepare.undistortion import write_scene

if TYPE_CHECKING:
    import pycolmap
    from matplotlib.axes import Axes


#: The palette of Okabe and Ito, which can be distinguished with any colour vision.
_COLORS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7A5C00")
_MOST_POINTS, _MOST_LINKS = 20_000, 4_000
#: Points outside these percentiles of the coordinates are not drawn.
_INNER: Final = (1.0, 99.0)
_MARGIN: Final = 0.15
#: Titles of the two panels if the scene is not georeferenced. The vertical direction is unknown in
#: this case.
_TITLES: Final = ("first and second axis of the cameras", "first and third axis of the cameras")


def draw(report: Report, model: "pycolmap.Reconstruction") -> bytes:
    """Return the figure of the report as PNG.

    Args:
        report: The facts about the scene.
        model: The model of the scene.
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
    """Draw points, links and cameras in the plane of two axes."""
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
    """Set the limits of the axes so that all cameras and most points are visible."""
    inner = np.percentile(points, _INNER, axis=0) if len(points) else cameras
    corners = np.vstack([inner, cameras])
    low, high = corners.min(0), corners.max(0)
    margin = _MARGIN * max(float((high - low).max()), 1e-9)
    axes.set_xlim(low[0] - margin, high[0] + margin)
    axes.set_ylim(low[1] - margin, high[1] + margin)


def _axes(centers: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rotation rows [3, 3]: the two directions of greatest camera spread, and the third."""
    return np.asarray(np.linalg.svd(centers - centers.mean(0), full_matrices=True)[2])


T = TypeVar("T")
_PAUSE = 5.0
#: Camera models of 360-degree photos.
_ALL_AROUND = "EQUIRECTANGULAR"


def prepare_scene(photos: Path, scene: Path, settings: Settings, threads: int | None) -> None:
    """Make a scene from a folder of photos, and print a summary.

    Raises:
        UserError: The same conditions as in `prepared`.
    """
    report = prepared(photos, scene, settings, threads)
    for line in summary_lines(report):
        print(one_line(line))  # noqa: T201 - print the result of the command
    print(one_line(f"scene in {scene}; the report is {scene / 'report.md'}"))  # noqa: T201
    length, command = advised(scene)
    print(f"planned length: {length}")  # noqa: T201
    print(one_line(f"next: {command}"))  # noqa: T201


def prepared(photos: Path, scene: Path, settings: Settings, threads: int | None = None) -> Report:
    """Make a scene, or its missing parts, from a folder of photos; return the report.

    Args:
        photos: Folder of the photos.
        scene: Folder of the scene.
        settings: The user's settings.
        threads: CPU threads, or None for all cores.

    Raises:
        UserError: There are too few photos, the scene folder contains other files, no photos match,
            or the disk is full.
    """
    layout = Layout(scene)
    check_ours(layout, photos)
    _check_lens(settings.lens)
    # If the scene is complete, its photos are no longer needed.
    plan = _planned(photos, settings, fewest=0 if layout.is_ready else 2)
    # Write nothing here, because other processes may read the folder, or the disk may be read-only.
    if layout.is_ready:
        return _carried_out(layout, agreed(layout, plan), 1)
    matching.check_gps(plan)
    with disk_errors(layout.work):
        layout.work.mkdir(parents=True, exist_ok=True)
    with locked(scene, "preparing"), resume_hint("run the same command again to continue"):
        clear_leftovers(layout)
        clear_damaged(layout)
        return _carried_out(layout, agreed(layout, plan), threads or len(available_cores()))


def made_or_ready(photos: Path, scene: Path, settings: Settings) -> list[str]:
    """Make a scene from photos, unless the scene is complete.

    The photos and the working folder of a complete scene may be missing.

    Returns:
        Messages about the scene.

    Raises:
        UserError: The same conditions as in `prepared`.
        UserError: The same conditions as in `prepared`.
    """
    layout, why = Layout(scene), ""
    if layout.is_ready and not layout.is_whole:
        why = f"{layout.work} is missing, which records how the scene was made"
    elif layout.is_ready and not has_photos(photos):
        why = f"{photos} no longer contains photos"
    messages = (
        [f"{why}: the scene is used unchanged"]
        if why
        else summary_lines(prepared(photos, scene, settings))
    )
    able = [name for name in entries("readers") if accepts(name, photos)]
    return messages + [
        (
            f"the folder already has poses (reader {name}), which are not used; leave "
            "--prepare out to train with them"
        )
        for name in able[:1]
    ]


def _check_lens(name: str) -> None:
    guard_pycolmap()
    import pycolmap

    unknown = {"INVALID", _ALL_AROUND}
    lenses = [model for model in pycolmap.CameraModelId.__members__ if model not in unknown]
    if name == _ALL_AROUND:
        raise UserError(
            "360-degree photos cannot be undistorted to a pinhole camera",
            where="--lens",
            expected=", ".join(lenses),
            found=name,
            todo="cut them into perspective photos, and prepare these photos",
        )
    if name not in lenses:
        raise UserError(
            "the camera model is unknown",
            where="--lens",
            expected=", ".join(lenses),
            found=name,
            todo="leave the option out to use SIMPLE_RADIAL",
        )


def _planned(photos: Path, settings: Settings, fewest: int) -> Plan:
    """Return the plan from the settings and the photo files."""
    progress = Progress(_PAUSE)

    def tell(done: int, of: int) -> None:
        progress.tell(f"reading photos: {done} of {of}")

    used, left_out = find_photos(photos, settings, tell, fewest)
    root = str(photos.resolve())
    return Plan(photos=root, settings=settings, used=used, left_out=left_out)


def _carried_out(layout: Layout, plan: Plan, threads: int) -> Report:
    """Run all stages and return the report."""
    features = _timed("features", lambda: found_features(layout, plan, threads))
    links = _timed("matches", lambda: matching.found_links(layout, plan, threads))
    models = _timed("poses", lambda: mapping.found_models(layout, plan, threads))
    result = _timed("place", lambda: placed(layout, plan, models))
    ways = matching.way_of(plan), mapping.way_of(plan)
    report = Report(plan, features, links, result, ways, mapping.misplaced(layout))
    _timed("photos", lambda: write_scene(layout, plan, threads))
    if not layout.report.is_file():
        _write_report(layout, report)
    return report


def _timed(what: str, stage: Callable[[], T]) -> T:
    begun = monotonic()
    result = stage()
    Progress().tell(f"{what}: {monotonic() - begun:.0f} s")
    return result


def _write_report(layout: Layout, report: Report) -> None:
    """Write georef.json, the figure and the reports.

    The file report.json is written last, because it marks a complete scene.
    """
    import pycolmap

    if report.result.georef is not None:
        content = json.dumps(report.result.georef, indent=1)
        write_atomically(layout.georef, content.encode())
    picture = draw(report, pycolmap.Reconstruction(layout.placed))
    write_atomically(layout.scene / "report.png", picture)
    write_atomically(layout.scene / "report.md", text_bytes(page_of(report)))
    write_atomically(layout.report, json.dumps(data_of(report), indent=1).encode())

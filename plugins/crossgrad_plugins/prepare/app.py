"""From photos to a scene, stage by stage; each goes on where it was interrupted."""

import json
from collections.abc import Callable
from pathlib import Path
from time import monotonic
from typing import TypeVar

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
from crossgrad_plugins.prepare.layout import Layout, check_ours, clear_damaged, clear_leftovers
from crossgrad_plugins.prepare.photos import find_photos, has_photos
from crossgrad_plugins.prepare.picture import draw
from crossgrad_plugins.prepare.plan import Plan, Settings, agreed
from crossgrad_plugins.prepare.report import Report, data_of, page_of, summary_lines
from crossgrad_plugins.prepare.results import placed
from crossgrad_plugins.prepare.undistortion import write_scene

T = TypeVar("T")
_PAUSE = 5.0
#: Camera model of photos that look in all directions.
_ALL_AROUND = "EQUIRECTANGULAR"


def prepare_scene(photos: Path, scene: Path, settings: Settings, threads: int | None) -> None:
    """Makes a scene of a folder of photos, and prints what was found.

    Raises:
        UserError: As `prepared`.
    """
    report = prepared(photos, scene, settings, threads)
    for line in summary_lines(report):
        print(one_line(line))  # noqa: T201 - the result of the command
    print(one_line(f"scene in {scene}; the report is {scene / 'report.md'}"))  # noqa: T201
    length, command = advised(scene)
    print(f"planned length: {length}")  # noqa: T201
    print(one_line(f"next: {command}"))  # noqa: T201


def prepared(photos: Path, scene: Path, settings: Settings, threads: int | None = None) -> Report:
    """Makes a scene of a folder of photos, or what is missing of it.

    Args:
        photos: Folder of the photos.
        scene: Folder of the scene.
        settings: What the user chose.
        threads: CPU threads; None for all there are.

    Raises:
        UserError: There are no photos, the folder of the scene is something else's, nothing fits
            together, or the disk is full.
    """
    layout = Layout(scene)
    check_ours(layout, photos)
    _check_lens(settings.lens)
    # A ready scene needs no photo any more.
    plan = _planned(photos, settings, fewest=0 if layout.is_ready else 2)
    if layout.is_ready:  # Nothing is written: others may read it, and the disk may be read-only.
        return _carried_out(layout, agreed(layout, plan), 1)
    matching.check_gps(plan)
    with disk_errors(layout.work):
        layout.work.mkdir(parents=True, exist_ok=True)
    with locked(scene, "preparing"), resume_hint("the same command goes on where this one ended"):
        clear_leftovers(layout)
        clear_damaged(layout)
        return _carried_out(layout, agreed(layout, plan), threads or len(available_cores()))


def made_or_ready(photos: Path, scene: Path, settings: Settings) -> list[str]:
    """Makes a scene of photos, unless it is ready: then photos and workshop may be gone.

    Returns:
        What is said about it.

    Raises:
        UserError: As `prepared`.
    """
    layout, why = Layout(scene), ""
    if layout.is_ready and not layout.is_whole:
        why = f"{layout.work} is gone, which says what it was made of"
    elif layout.is_ready and not has_photos(photos):
        why = f"there are no photos in {photos} any more"
    told = (
        [f"{why}: the scene is taken as it is"]
        if why
        else summary_lines(prepared(photos, scene, settings))
    )
    able = [name for name in entries("readers") if accepts(name, photos)]
    return told + [
        f"the folder has poses of its own (reader {name}), which are not used; to train with them, "
        "leave --prepare out"
        for name in able[:1]
    ]


def _check_lens(name: str) -> None:
    guard_pycolmap()
    import pycolmap

    unknown = {"INVALID", _ALL_AROUND}
    known = [each for each in pycolmap.CameraModelId.__members__ if each not in unknown]
    if name == _ALL_AROUND:
        raise UserError(
            "360-degree photos have no pinhole camera to be undistorted to",
            where="--lens",
            expected=", ".join(known),
            found=name,
            todo="cut them into perspective photos, and prepare those",
        )
    if name not in known:
        raise UserError(
            "there is no such camera model",
            where="--lens",
            expected=", ".join(known),
            found=name,
            todo="leave it out for SIMPLE_RADIAL",
        )


def _planned(photos: Path, settings: Settings, fewest: int) -> Plan:
    """The photos and what their files say."""
    progress = Progress(_PAUSE)

    def tell(done: int, of: int) -> None:
        progress.tell(f"looking at photos: {done} of {of}")

    used, left_out = find_photos(photos, settings, tell, fewest)
    root = str(photos.resolve())
    return Plan(photos=root, settings=settings, used=used, left_out=left_out)


def _carried_out(layout: Layout, plan: Plan, threads: int) -> Report:
    """All stages."""
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
    found = stage()
    Progress().tell(f"{what}: {monotonic() - begun:.0f} s")
    return found


def _write_report(layout: Layout, report: Report) -> None:
    """Writes what else is in the scene's folder; the data last, which says that all is there."""
    import pycolmap

    if report.result.georef is not None:
        content = json.dumps(report.result.georef, indent=1)
        write_atomically(layout.georef, content.encode())
    picture = draw(report, pycolmap.Reconstruction(layout.placed))
    write_atomically(layout.scene / "report.png", picture)
    write_atomically(layout.scene / "report.md", text_bytes(page_of(report)))
    write_atomically(layout.report, json.dumps(data_of(report), indent=1).encode())

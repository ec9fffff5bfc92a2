"""Decisions about initialization, held-out photos, lenses, masks and background."""

import re
from collections import Counter
from typing import Final

from crossgrad_plugins.planner.evidence import Evidence
from crossgrad_plugins.planner.finding import Finding, given

#: A scene with only one photo has no shared points.
_ONE_PHOTO: Final = 1
#: Beginning of the reader's note about the colour over which transparent photos were blended.
_BLENDED: Final = re.compile(r"blended over RGB \(([\d.]+), ([\d.]+), ([\d.]+)\)")


def start(evidence: Evidence) -> Finding:
    """Decide the points from which training starts."""
    part, config = "initializer", evidence.config
    if evidence.is_given("initializer", "data.init"):
        chosen = config.initializer.name if config.initializer else config.data.init
        return given(part, chosen, "--initializer NAME or --init")
    points, views = len(evidence.scene.points), len(evidence.scene.train_views)
    figures = {"points": points, "views": views}
    plain = Finding(
        part,
        "default of a run",
        "default",
        "",
        "points found in photos if the scene has none; random points for a single photo",
        "docs/initializers.md",
        "--initializer NAME or --init random",
    )
    if points:
        return plain.found(f"{points:,} SfM points", figures=figures)
    shown = plain.found(f"no SfM points, {views} training photos", figures=figures)
    if views > _ONE_PHOTO:
        return shown.changed(
            "triangulated",
            {"initializer": "triangulated"},
            "the scene has no SfM points",
            "--init random",
        )
    return shown.changed(
        "random points", {"data.init": "random"}, "a single photo, no SfM points", "--init FILE.ply"
    )


def held_out(evidence: Evidence) -> Finding:
    """Report which photos are held out, and if every regime has held-out photos."""
    part, scene = "held out", evidence.scene
    photos = Counter(view.regime for view in scene.test_views)
    chosen = ", ".join(f"{number} of {name}" for name, number in sorted(photos.items())) or "none"
    if evidence.is_given("data.split", "data.test_every"):
        return given(part, chosen, "--split HOW")
    plain = Finding(
        part,
        chosen,
        "default",
        "",
        "the scene's lists, else 1 in 8 of each folder by name",
        "docs/readers.md",
        "--split stratified",
    )
    lacking = sorted({view.regime for view in scene.train_views} - set(photos))
    if not lacking:
        return plain.found("every regime has held-out photos", decided=True)
    return plain.found(
        f"no metric shows the quality of {' and '.join(lacking)}: no photo of it is held out"
    )


def undistortion(evidence: Evidence) -> Finding:
    """Report if photos were undistorted."""
    note = evidence.scene_note("undistorted")
    plain = Finding(
        "undistortion",
        "photos are undistorted" if note else "none",
        "default",
        "",
        "if the camera model is not a pinhole",
        "the scene's cameras",
        "undistorted photos",
    )
    if note:
        return plain.found(note.removeprefix("photos: "), decided=True)
    return plain.found("all cameras are pinholes", decided=True, saved="a resampling of each photo")


def masks(evidence: Evidence) -> Finding:
    """Report if pixels are masked."""
    part = "masks"
    if evidence.is_given("data.masks"):
        return given(part, evidence.config.data.masks, "--set data.masks=FOLDER")
    note = evidence.scene_note("masks: ") or evidence.scene_note("alpha < 0.5")
    plain = Finding(
        part,
        "masked pixels do not count" if note else "none",
        "default",
        "",
        "if the scene has masks, or photos with transparency",
        "the scene's folder",
        "--set data.masks=FOLDER",
    )
    if note:
        return plain.found(note, decided=True)
    return plain.found("no photo has a mask", decided=True, saved="weights of pixels")


def background(evidence: Evidence) -> Finding:
    """Decide the background colour of renders."""
    part, configured = "background", evidence.config.background
    if evidence.is_given("background"):
        return given(part, configured, "--background COLOR")
    plain = Finding(
        part,
        configured,
        "default",
        "",
        "the colour that transparent photos were blended over, else black, as in viewers",
        "docs/initializers.md; docs/readers.md",
        "--background COLOR",
    )
    note = evidence.scene_note("blended over RGB")
    match = _BLENDED.search(note) if note else None
    if note is None or match is None:
        return plain.found("no photo is transparent", decided=True)
    color = ",".join(f"{float(level):g}" for level in match.groups())
    name = {"0,0,0": "black", "1,1,1": "white"}.get(color, color)
    shown = plain.found(note.removeprefix("photos: "), decided=True)
    if name == configured:
        return shown
    because = "transparent photos were blended over it"
    return shown.changed(name, {"background": name}, because, "--background COLOR")

"""Resolution and its schedule, number of primitives, length, and density control."""

from dataclasses import replace
from typing import Final

from crossgrad_core.commands import (
    DEFAULT_STEPS,
    RunConfig,
    edits_of,
    photos_per_point,
    table_of,
)
from crossgrad_core.plugin import Resolution, build_component
from crossgrad_plugins.planner.decision import NOTHING, Decision, given
from crossgrad_plugins.planner.evidence import Evidence
from crossgrad_plugins.planner.groups import views_of_steps

#: Share of a step's time that goes with its pixels, as docs/resolutions.md has it.
_OF_PIXELS: Final = 0.6
#: Photos whose spectra are looked at, at most, spread over all.
_PHOTOS: Final = 8
_FEW: Final = "docs/few-photos.md"
_EXACTLY: Final = "--steps N or --max-views N"
_FLAT: Final = "docs/plan.md, four scenes"
#: Views of each training photo after which more of them stop to pay, and of all together at least.
PASSES: Final = 100
FEWEST_VIEWS: Final = 1_000


def resolution(evidence: Evidence) -> Decision:
    """At which sizes steps render."""
    part, named = "resolution", evidence.config.resolution
    if evidence.is_given("resolution") and named is not None:
        return given(part, named.name, "--resolution NAME")
    from crossgrad_plugins.resolutions.spectral import Spectral

    train = evidence.scene.train
    part_of_it = replace(evidence.scene, train=train[:: -(-len(train) // _PHOTOS) or 1])
    found = build_component(Resolution, "spectral", {}).fitted_to(part_of_it)
    courses = found.courses if isinstance(found, Spectral) else None
    pixels = sum(
        each.photos * sum(scale**2 for scale in each.scales or (1.0,)) / len(each.scales or (1.0,))
        for each in (courses or {}).values()
    )
    pixels /= max(1, len(part_of_it.train))
    return Decision(
        part,
        "as suits the length and the photos",
        "default",
        f"small photos first would render {pixels:.0%} of the pixels up to the end of density "
        f"control, about {_OF_PIXELS * (1.0 - pixels):.0%} less time there; at equal seconds that "
        "was not ahead of full size beyond its interval over our scenes",
        "some of the pixels first in short runs on a CPU, else full size; small photos first once "
        "they are measured to gain",
        "docs/resolutions.md; DashGaussian: 46 % less time, published",
        "--resolution spectral",
        figures={"share_of_pixels": pixels},
    )


def count(evidence: Evidence) -> Decision:
    """How many primitives there may be."""
    part, config = "primitives", evidence.config
    if evidence.is_given("max_gaussians", "growth"):
        return given(part, config.max_gaussians or config.growth, "--max-gaussians N")
    points, steps = len(evidence.scene.points), _steps(evidence)
    plain = Decision(
        part,
        "as suits the length",
        "default",
        "",
        "30,000 or the start's, more in longer runs and of larger photos; no bound from 30,000 "
        "views on",
        "docs/schedules.md (Taming 3DGS, metal-gauss)",
        "--max-gaussians N",
    )
    if steps is None:
        return plain.found(f"{points:,} points; the length follows the clock")
    views = views_of_steps(evidence).paced(steps).views(steps)
    pixels = evidence.scene.train_pixels
    budget = table_of(_with_length(evidence), evidence.scene, points)["max_gaussians"].value
    shown = f"up to {budget:,}" if budget else "no bound"
    return plain.found(
        f"{points:,} points, {views:,} views, photos of {pixels / 1e6:.2f} MP: {shown}",
        figures={"points": points, "views": views, "pixels": pixels},
    )


def most_views(evidence: Evidence) -> int:
    """After how many views more of them stop to pay."""
    return max(FEWEST_VIEWS, PASSES * len(evidence.scene.train_views))


def length(evidence: Evidence) -> Decision:
    """How long the run is."""
    part, config, photos = "length", evidence.config, len(evidence.scene.train_views)
    most, seconds = most_views(evidence), config.seconds
    within = "" if seconds is None else f" within {seconds:g} s"
    asked = f"{DEFAULT_STEPS:,} steps" if seconds is None else f"{seconds:g} s"
    if config.steps is not None:
        return given(part, f"{config.steps:,} steps", _EXACTLY)
    if config.max_views is not None:
        return given(part, f"{config.max_views:,} views{within}", _EXACTLY)
    plain = Decision(
        part,
        asked,
        "default",
        "",
        f"{PASSES} views of each training photo, {FEWEST_VIEWS:,} at least: more of them gain "
        "little and take long, as Gaussians grow",
        _FLAT,
        _EXACTLY,
    )
    if not evidence.is_measured or config.schedule == "absolute":
        return plain.found("a published schedule, which a shorter run would cut")
    if not photos:
        return plain.found("no training photos")
    shown = f"{most // photos:,} views of each of {photos:,} training photos"
    usual = views_of_steps(evidence).paced(DEFAULT_STEPS).views(DEFAULT_STEPS)
    if seconds is None and most >= usual:
        return plain.found(shown, decided=True, figures={"views": most})
    saved = f"what is left of {asked} then"
    if seconds is None:
        saved = f"{1.0 - most / usual:.0%} of the views of {asked}"
    found = plain.found(shown, figures={"views": most})
    return found.changed(f"{most:,} views{within}", {"max_views": most}, _EXACTLY, saved)


def densifier(evidence: Evidence) -> Decision:
    """Whether there is density control."""
    part, named = "densifier", evidence.config.densifier
    usual = _usual_densifier(evidence) if named is None or named.name == "auto" else named.name
    if evidence.is_given("densifier", "backbone"):
        return given(part, usual, "--densifier NAME")
    rule = "none where the schedule has no edit: the run is over before the first transient is"
    plain = Decision(part, usual, "default", "", rule, "docs/schedules.md", "--densifier NAME")
    steps = _steps(evidence)
    if not steps:
        return plain.found("the length follows the clock, and edits follow the length")
    if evidence.is_given(*_EDITS):
        return plain.found("edits are as you set them")
    edits = edits_of(_with_length(evidence), evidence.scene)
    shown = plain.found(f"{edits} edits in {steps:,} steps", decided=True, figures={"edits": edits})
    if edits:
        return shown
    saved = "its screen statistics, and its module"
    return shown.changed("none", {"densifier": "none"}, f"--densifier {usual}", saved)


def _usual_densifier(evidence: Evidence) -> str:
    """That of a run that names none and has the length decided on."""
    row = table_of(_with_length(evidence), evidence.scene).get("densifier")
    return evidence.backbone.default_densifier if row is None else str(row.value)


def _with_length(evidence: Evidence) -> RunConfig:
    """The configuration with the decision on the length."""
    return evidence.config.model_copy(update=dict(length(evidence).settings))


def _steps(evidence: Evidence) -> int | None:
    """Length of the run in steps, the decision on it included; None where it follows the clock."""
    config = evidence.config
    if config.seconds is not None:
        return None
    views = length(evidence).settings.get("max_views", config.max_views)
    if isinstance(views, int):
        return views_of_steps(evidence).steps_of(views)
    return config.steps or DEFAULT_STEPS


def dropout(evidence: Evidence) -> Decision:
    """Whether training views are drawn without a share of the Gaussians."""
    part, config = "dropout", evidence.config
    force = "--rule dropout, --no-rule dropout"
    if evidence.is_given("rules.dropout"):
        return given(part, _share(config.rules["dropout"]), force)
    rule = "some where a point lies in at most 5 photos; where more show it, no gain was measured"
    photos = photos_per_point(evidence.scene)
    row = table_of(evidence.config, evidence.scene).get("rules.dropout")
    share = row is not None and row.value
    plain = Decision(part, _share(share), "default", "", rule, _FEW, force)
    if not photos:
        return plain.found("no SfM points tell how many photos show the same")
    shown = f"a point lies in {photos:g} of {len(evidence.scene.train_views)} photos (median)"
    saved = NOTHING if share else "a random number for each Gaussian of a view"
    return plain.found(shown, decided=True, saved=saved, figures={"photos_of_a_point": photos})


def _share(options: object) -> str:
    """The share of a rule's options, in words."""
    return f"{options.get('share', 'usual')}" if isinstance(options, dict) else "none"


#: Settings that only make sense with density control.
_EDITS: Final = (
    *("densify_from", "densify_until", "densify_every", "min_refinements", "reset_every"),
    *("densify_views", "max_gaussians", "growth"),
)

"""The decision about the length of a run."""

from typing import Final

from crossgrad_core.commands import DEFAULT_STEPS
from crossgrad_plugins.planner.evidence import Evidence
from crossgrad_plugins.planner.finding import Finding, given
from crossgrad_plugins.planner.grouping import views_of_steps

_EXACTLY: Final = "--steps N or --max-views N"
#: Number of views per training photo, and minimum total number of views. Runs with more views than
#: both numbers improve little.
PASSES: Final = 100
FEWEST_VIEWS: Final = 1_000


def most_views(evidence: Evidence) -> int:
    """Return the number of views after which further views improve the result little."""
    return max(FEWEST_VIEWS, PASSES * len(evidence.scene.train_views))


def length(evidence: Evidence) -> Finding:
    """Decide the length of the run."""
    part, config, photos = "length", evidence.config, len(evidence.scene.train_views)
    most, seconds = most_views(evidence), config.seconds
    within = "" if seconds is None else f" within {seconds:g} s"
    full_length = f"{DEFAULT_STEPS:,} steps" if seconds is None else f"{seconds:g} s"
    if config.steps is not None:
        return given(part, f"{config.steps:,} steps", _EXACTLY)
    if config.max_views is not None:
        return given(part, f"{config.max_views:,} views{within}", _EXACTLY)
    plain = Finding(
        part,
        full_length,
        "default",
        "",
        f"{PASSES} views of each training photo, at least {FEWEST_VIEWS:,}: more "
        "views gain little and take long, because the number of Gaussians grows",
        "docs/plan.md, four scenes",
        _EXACTLY,
    )
    if not evidence.is_measured or config.schedule == "absolute":
        return plain.found("a published schedule, which a shorter run would cut off")
    if not photos:
        return plain.found("no training photos")
    shown = f"{most // photos:,} views of each of {photos:,} training photos"
    views = views_of_steps(evidence).paced(DEFAULT_STEPS).views(DEFAULT_STEPS)
    if seconds is None and most >= views:
        return plain.found(shown, decided=True, figures={"views": most})
    saved = f"the remaining part of {full_length}"
    if seconds is None:
        saved = f"{1.0 - most / views:.0%} of the views of {full_length}"
    because = f"more than {most // photos:,} views of each photo gain little"
    finding = plain.found(shown, figures={"views": most})
    return finding.changed(f"{most:,} views{within}", {"max_views": most}, because, _EXACTLY, saved)

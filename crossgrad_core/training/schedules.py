"""The schedule of a run, and what is said where it leaves density control out."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final, Literal

from crossgrad_core.config import AUTO, RunConfig
from crossgrad_core.contract.densifier import Densifier
from crossgrad_core.contract.pace import ViewsPerStepSpec
from crossgrad_core.contract.schedule import (
    REFERENCE,
    SHORTEST_RUN_WITH_EDITS,
    USUAL_EDITS,
    Counting,
    Schedule,
    Unit,
    is_published,
    shortness,
)
from crossgrad_core.training.rates import in_a_hurry
from crossgrad_core.training.setup import Setup

#: Share of a short run in a hurry before harmonics above degree 0 are drawn: until then they cost
#: time and are worth little. Measured by us (docs/schedules.md).
SH_AFTER: Final = 0.5
#: The highest degree of harmonics.
MOST_DEGREES: Final = 3

#: Times of density control that the user may set.
_EDITS = ("densify_from", "densify_until", "densify_every")


def counting_of(
    config: RunConfig, views: ViewsPerStepSpec, photos: int, *, budgeted: bool
) -> Counting:
    """What the schedule of a run counts.

    Args:
        config: Its configuration.
        views: How many views its steps have.
        photos: Its training photos.
        budgeted: Whether its density control is led along a curve by itself.
    """
    plain = Counting(unit_of(config), views, photos, config.reference, config.min_refinements or 0)
    # Without a budget early growth copies nearly everything, and a short run ends lower.
    if config.min_refinements is not None or growth_by(config, budgeted=budgeted) == "free":
        return plain
    return replace(plain, min_refinements=USUAL_EDITS, edits_from=SHORTEST_RUN_WITH_EDITS)


def growth_of(setup: Setup) -> Literal["free", "curve"]:
    """How the number of primitives grows: as was asked for, else as suits the densifier."""
    return growth_by(setup.config, budgeted=setup.densifier.budgeted)


def growth_by(config: RunConfig, *, budgeted: bool) -> Literal["free", "curve"]:
    """The same before there is a run; `budgeted`: `Densifier.budgeted` of its densifier."""
    if config.growth is not None:
        return config.growth
    # A bound that somebody names is a bound and no aim, and published times have published growth.
    named = config.max_gaussians not in {None, AUTO}
    led = budgeted and unit_of(config) == "views"
    return "curve" if led and not named else "free"


def is_led(config: RunConfig, densifier: Densifier, schedule: Schedule) -> bool:
    """Whether growth follows the curve, in a run shorter than the published ones."""
    short = schedule.length < REFERENCE
    return short and growth_by(config, budgeted=densifier.budgeted) == "curve"


def unit_of(config: RunConfig) -> Unit:
    """What events are counted in: steps where published numbers are to hold, elsewhere views."""
    if config.events is not None:
        return config.events
    published = is_published(config.schedule, config.reference)
    return "steps" if published or config.preset == "inria" else "views"


def schedule_of(
    config: RunConfig, densifier: Densifier, steps: int, counting: Counting
) -> Schedule:
    """The schedule of a run of `steps` steps: the densifier's times, then what the user set."""
    schedule = densifier.window(Schedule.for_run(steps, config.schedule, counting))
    if is_led(config, densifier, schedule):
        # They hold back growth, which the curve does, and with them goes what fills the far ground.
        schedule = replace(schedule, reset_every=None)
    edits = _given(config, _EDITS)
    schedule = replace(schedule, sh_wait=_before_harmonics(config, schedule))
    schedule = replace(schedule, **edits, **_given(config, ("reset_every", "sh_from", "sh_every")))
    # What the user sets stays, whatever the length.
    return replace(schedule, min_refinements=0) if edits else schedule


def _before_harmonics(config: RunConfig, schedule: Schedule) -> int:
    """The count before which harmonics above those of the first step are not drawn."""
    # Another schedule than the run's own may be longer than the run.
    length = min(schedule.length, schedule.counted(schedule.total))
    if config.sh_start is not None:
        return round(config.sh_start * length)
    ours = schedule.counting.unit == "views" and not schedule.published
    waits = ours and in_a_hurry(config, schedule, schedule.counting.photos)
    return int(SH_AFTER * shortness(schedule.length) * length) if waits else 0


def _given(config: RunConfig, names: tuple[str, ...]) -> Mapping[str, Any]:
    return {name: getattr(config, name) for name in names if getattr(config, name) is not None}


def notes_on_length(setup: Setup) -> tuple[str, ...]:
    """What is noted about a run of this length."""
    resolution = setup.selection.resolution
    messages = resolution.messages(setup.schedule)
    return (*growth_note(setup), *_curve_note(setup), *_harmonics_note(setup), *messages)


def _harmonics_note(setup: Setup) -> tuple[str, ...]:
    """Says that harmonics come late, where nobody asked for it."""
    schedule, banded = setup.schedule, any(block.rests for block in setup.trained_blocks)
    usual = setup.config.sh_start is None and banded and schedule.sh_from < MOST_DEGREES
    if not usual or schedule.sh_wait <= schedule.sh_interval:
        return ()
    return (
        f"harmonics above degree {schedule.sh_from} are drawn after {schedule.sh_wait:,} views "
        "(--set sh_start=0: degree by degree from the start, as published)",
    )


def _curve_note(setup: Setup) -> tuple[str, ...]:
    """Says that growth follows the curve, where nobody asked for it."""
    if not setup.schedule.grows or setup.config.growth or growth_of(setup) == "free":
        return ()
    resets = "" if setup.schedule.reset_every else ", without resets of the opacities"
    return (
        "growth follows a curve to the number of primitives that suits the length (--max-gaussians "
        f"auto){resets}; --growth free adds as many as density control asks for, as published",
    )


def growth_note(setup: Setup) -> tuple[str, ...]:
    """Says that density control is left out, where the run is too short for it."""
    schedule = setup.schedule
    if not setup.densifier.edits or schedule.grows:
        return ()
    start, end, unit = schedule.densify_from, schedule.densify_until, schedule.counting.unit
    return (
        f"no density control: in {schedule.total} steps it would begin after {start} {unit} and "
        f"end before {end}; --set densify_from=N forces it",
    )

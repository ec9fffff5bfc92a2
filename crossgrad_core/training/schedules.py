"""The schedule of a run, and what is said where it leaves density control out."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.schedule import Counting, Schedule
from crossgrad_core.contract.slots.densifier import Densifier
from crossgrad_core.training.numbers import Numbers
from crossgrad_core.training.setup import Setup

#: The highest degree of harmonics.
MOST_DEGREES: Final = 3

#: Times of density control that the user may set.
_EDITS = ("densify_from", "densify_until", "densify_every")


def schedule_of(
    config: RunConfig, densifier: Densifier, steps: int, counting: Counting
) -> Schedule:
    """The schedule of a run of `steps` steps: the densifier's times, then what is set.

    Args:
        config: The configuration; of its settings, those of edits and of SH bands count.
        densifier: The densifier.
        steps: Length of the run.
        counting: Views of the steps, and photos.
    """
    numbers = Numbers.of(config)
    counting = replace(
        counting, unit=numbers.schedule_unit, min_refinements=numbers.min_refinements
    )
    schedule = densifier.window(Schedule.for_run(steps, config.schedule, counting))
    edits = _given(config, _EDITS)
    # Another schedule than the run's own may be longer than the run.
    length = min(schedule.length, schedule.counted(schedule.total))
    schedule = replace(
        schedule,
        reset_every=numbers.reset_every or None,
        sh_from=config.sh_from or 0,
        sh_wait=round(numbers.sh_start * length),
        **edits,
    )
    # What the user sets stays, whatever the length.
    return replace(schedule, min_refinements=0) if edits else schedule


def _given(config: RunConfig, names: tuple[str, ...]) -> Mapping[str, Any]:
    return {name: getattr(config, name) for name in names if getattr(config, name) is not None}


def notes_on_length(setup: Setup) -> tuple[str, ...]:
    """What is noted about a run of this length."""
    resolution = setup.selection.resolution
    messages = resolution.messages(setup.schedule)
    return (*growth_note(setup), *messages)


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

"""Create the schedule of a run, and the note for a run that is too short for density control."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.schedule import Counting, Schedule
from crossgrad_core.contract.slots.densifier import Densifier
from crossgrad_core.training.numbers import Numbers
from crossgrad_core.training.setup import Setup

#: Highest degree of spherical harmonics.
MOST_DEGREES: Final = 3

#: Settings of the times of density control.
_EDITS = ("densify_from", "densify_until", "densify_every")


def schedule_of(
    config: RunConfig, densifier: Densifier, steps: int, counting: Counting
) -> Schedule:
    """Return the schedule of a run of `steps` steps.

    The densifier chooses when edits occur. Settings by the user override this choice.

    Args:
        config: The configuration. The settings of the schedule, edits and SH bands are used.
        densifier: The densifier, which chooses when edits occur.
        steps: Number of steps of the run.
        counting: Number of views in each step, and number of photos.
    """
    numbers = Numbers.of(config)
    counting = replace(
        counting, unit=numbers.schedule_unit, min_refinements=numbers.min_refinements
    )
    schedule = densifier.window(Schedule.for_run(steps, config.schedule, counting))
    edits = _given(config, _EDITS)
    # The schedule may be longer than the run, unless the schedule is scaled to the length of the
    # run.
    length = min(schedule.length, schedule.counted(schedule.total))
    schedule = replace(
        schedule,
        reset_every=numbers.reset_every or None,
        sh_from=config.sh_from or 0,
        sh_wait=round(numbers.sh_start * length),
        **edits,
    )
    # If the user set the times of edits, `min_refinements` must not change these times.
    return replace(schedule, min_refinements=0) if edits else schedule


def _given(config: RunConfig, names: tuple[str, ...]) -> Mapping[str, Any]:
    return {name: getattr(config, name) for name in names if getattr(config, name) is not None}


def notes_on_length(setup: Setup) -> tuple[str, ...]:
    """Return the notes to the user that depend on the length of the run."""
    resolution = setup.selection.resolution
    messages = resolution.messages(setup.schedule)
    return (*growth_note(setup), *messages)


def growth_note(setup: Setup) -> tuple[str, ...]:
    """Return a note if the run is too short for density control, else an empty tuple."""
    schedule = setup.schedule
    if not setup.densifier.edits or schedule.grows:
        return ()
    start, end, unit = schedule.densify_from, schedule.densify_until, schedule.counting.unit
    return (
        (
            f"no density control: in a run of {schedule.total} steps it would begin after "
            f"{start} {unit} and end before {end}; --set densify_from=N forces it"
        ),
    )

"""The schedule of a run, and what is said where it leaves density control out."""

from dataclasses import replace

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.densifier import Densifier
from crossgrad_core.contract.schedule import Schedule
from crossgrad_core.training.setup import Setup


def schedule_of(config: RunConfig, densifier: Densifier, steps: int) -> Schedule:
    """The schedule of a run of `steps` steps: the densifier's times, then what the user set."""
    names = ("densify_from", "densify_until", "densify_every", "reset_every", "sh_from")
    given = {name: getattr(config, name) for name in names if getattr(config, name) is not None}
    return replace(densifier.window(Schedule.for_run(steps, config.schedule)), **given)


def growth_note(setup: Setup) -> tuple[str, ...]:
    """Says that density control is left out, where the run is too short for it."""
    if not setup.densifier.edits or setup.schedule.grows:
        return ()
    start, end = setup.schedule.densify_from, setup.schedule.densify_until
    return (
        f"no density control: in {setup.schedule.total} steps it would end (step {end}) before the "
        f"first transient is over (step {start}); --set densify_from=N forces it",
    )

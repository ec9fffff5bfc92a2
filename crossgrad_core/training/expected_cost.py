"""Expected cost of steps: their views, the pixels of these, and the primitives there will be."""

from dataclasses import dataclass
from statistics import fmean

from crossgrad_core.contract.schedule import Schedule
from crossgrad_core.training.growth_budget import most_after, started_with
from crossgrad_core.training.schedules import schedule_of
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState

#: What each edit of density control adds to the mean cost of a step, in units of a step at the
#: start: chosen on runs with four edits. The clock corrects it as a run goes.
COST_PER_EDIT = 0.2
#: Growth slows down: more edits than these are not counted.
COUNTED_EDITS = 5
#: So many pixels cost what a Gaussian costs. Source: steps of one view and of two with 7,000 to
#: 50,000 Gaussians on four scenes at 400 px (`benchmarks/grids/two_views_tuning.yaml`).
PIXELS_PER_PRIMITIVE = 8.0


@dataclass(frozen=True)
class PrimitiveCounts:
    """The primitives of a run.

    Attributes:
        start: How many it began with.
        present: How many there are.
    """

    start: int
    present: int

    @classmethod
    def of(cls, setup: Setup, state: TrainState) -> "PrimitiveCounts":
        """Those of a run that has reached this state."""
        return cls(started_with(setup, state), state.primitives(setup))


def cost_of_run(setup: Setup, crowd: PrimitiveCounts, steps: int) -> float:
    """Expected cost of a run of so many steps, in units of a view of full size at its start."""
    setup = setup.at_length(steps, crowd.start)
    schedule = schedule_for(setup, steps)
    return views_of(setup, schedule, 0, steps) * growth_ahead(setup, crowd, schedule, 0)


def cost_ahead(setup: Setup, crowd: PrimitiveCounts, step: int, left: int) -> float:
    """Expected cost of the `left` steps after `step`, in units of a view of full size now."""
    setup = setup.at_length(step + left, crowd.start)
    schedule = setup.schedule.with_length(schedule_for(setup, step + left), step)
    views = views_of(setup, schedule, step, step + left)
    return views * growth_ahead(setup, crowd, schedule, step)


def schedule_for(setup: Setup, steps: int) -> Schedule:
    """The schedule that the run would have, were it so long from its start."""
    return schedule_of(setup.in_force, setup.densifier, steps, setup.schedule.counting)


def views_of(setup: Setup, schedule: Schedule, after: int, until: int) -> float:
    """Expected cost of the steps after one and up to another one, in views of full size."""
    resolution = setup.selection.resolution
    views = schedule.pace.views(until) - schedule.pace.views(after)
    pixels = resolution.pixels(schedule, until) - resolution.pixels(schedule, after)
    return views + setup.pixel_share * (pixels - views)


def growth_ahead(setup: Setup, crowd: PrimitiveCounts, schedule: Schedule, step: int) -> float:
    """Mean cost of a view in the steps after `step`, over its cost with the primitives of now."""
    if not setup.densifier.edits:
        return 1.0
    ahead = schedule.edits(step)
    if ahead and setup.numbers.growth == "budget":
        # A budget that no run fills, as that of nearly the published length, bounds nothing.
        return min(1.0 + COST_PER_EDIT * COUNTED_EDITS, _along_curve(setup, crowd, schedule, step))
    done = schedule.edits_before + schedule.edits() - ahead
    return 1.0 + COST_PER_EDIT * min(ahead, max(0, COUNTED_EDITS - done))


def _along_curve(setup: Setup, crowd: PrimitiveCounts, schedule: Schedule, step: int) -> float:
    """The same where growth follows the curve to its budget."""
    cameras = [view.camera for view in setup.train_views]
    # What a view without any primitive costs, in primitives.
    empty = fmean(camera.width * camera.height for camera in cameras) / PIXELS_PER_PRIMITIVE
    cost, at, count = 0.0, step, crowd.present
    for edit in schedule.edit_steps(step):
        cost += (edit - at) * (empty + count)
        at, count = edit, max(count, most_after(setup, schedule, edit, crowd.start))
    cost += (schedule.total - at) * (empty + count)
    return cost / ((schedule.total - step) * (empty + crowd.present))

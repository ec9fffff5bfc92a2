"""Choose the number of steps that fits into a time budget; revise the number during training."""

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import ceil
from statistics import fmean
from typing import Protocol

from crossgrad_core.contract.schedule import Schedule
from crossgrad_core.numerics.kernel_cache import notes_on_missing
from crossgrad_core.training.growth_budget import most_after, started_with
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.schedules import growth_note, notes_on_length, schedule_of
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.start import first_state, unwatched
from crossgrad_core.training.state import ClockKind, TrainState

#: Each edit by density control increases the mean cost of a step. The increase is this share of the
#: cost of a step at the start. The value was measured in runs with four edits. During a run,
#: measured times replace this estimate.
COST_PER_EDIT = 0.2
#: Maximum number of edits that increase the estimated cost. The number of primitives grows more
#: slowly after the first edits.
COUNTED_EDITS = 5
#: Number of pixels that take as much rendering time as one Gaussian. Source:
#: `benchmarks/grids/two_views_tuning.yaml`.
PIXELS_PER_PRIMITIVE = 8.0


@dataclass(frozen=True)
class PrimitiveCounts:
    """The numbers of primitives at the start of a run and now.

    Attributes:
        start: Number of primitives at the start.
        present: Present number of primitives.
    """

    start: int
    present: int

    @classmethod
    def of(cls, setup: Setup, state: TrainState) -> "PrimitiveCounts":
        """Return the initial and the present number of primitives of a run."""
        return cls(started_with(setup, state), state.primitives(setup))


def cost_of_run(setup: Setup, crowd: PrimitiveCounts, steps: int) -> float:
    """Return the expected cost of a run of `steps` steps.

    The unit is the cost of a full-size view at the start.
    """
    setup = setup.at_length(steps, crowd.start)
    schedule = schedule_for(setup, steps)
    return views_of(setup, schedule, 0, steps) * growth_ahead(setup, crowd, schedule, 0)


def cost_ahead(setup: Setup, crowd: PrimitiveCounts, step: int, left: int) -> float:
    """Return the expected cost of `left` steps after `step`.

    The unit is the cost of a full-size view at `step`.
    """
    setup = setup.at_length(step + left, crowd.start)
    schedule = setup.schedule.with_length(schedule_for(setup, step + left), step)
    views = views_of(setup, schedule, step, step + left)
    return views * growth_ahead(setup, crowd, schedule, step)


def schedule_for(setup: Setup, steps: int) -> Schedule:
    """Return the schedule of the run if its total number of steps were `steps`."""
    return schedule_of(setup.in_force, setup.densifier, steps, setup.schedule.counting)


def views_of(setup: Setup, schedule: Schedule, after: int, until: int) -> float:
    """Return the number of full-size views that cost as much as steps `after + 1` to `until`."""
    resolution = setup.selection.resolution
    views = schedule.pace.views(until) - schedule.pace.views(after)
    pixels = resolution.pixels(schedule, until) - resolution.pixels(schedule, after)
    return views + setup.pixel_share * (pixels - views)


def growth_ahead(setup: Setup, crowd: PrimitiveCounts, schedule: Schedule, step: int) -> float:
    """Return the expected mean cost of a view after `step`, divided by the present cost."""
    if not setup.densifier.edits:
        return 1.0
    ahead = schedule.edits(step)
    if ahead and setup.numbers.growth == "budget":
        # Some primitive budgets exceed the number of primitives that a run reaches, for example in
        # runs of about the published length. Without this limit, the cost of runs with a very large
        # primitive budget would be overestimated.
        return min(1.0 + COST_PER_EDIT * COUNTED_EDITS, _along_curve(setup, crowd, schedule, step))
    done = schedule.edits_before + schedule.edits() - ahead
    return 1.0 + COST_PER_EDIT * min(ahead, max(0, COUNTED_EDITS - done))


def _along_curve(setup: Setup, crowd: PrimitiveCounts, schedule: Schedule, step: int) -> float:
    """Return the result of `growth_ahead` if the number of primitives follows the budget curve."""
    cameras = [view.camera for view in setup.train_views]
    # Cost of rendering a view without Gaussians, as an equivalent number of Gaussians.
    empty = fmean(camera.width * camera.height for camera in cameras) / PIXELS_PER_PRIMITIVE
    cost, at, count = 0.0, step, crowd.present
    for edit in schedule.edit_steps(step):
        cost += (edit - at) * (empty + count)
        at, count = edit, max(count, most_after(setup, schedule, edit, crowd.start))
    cost += (schedule.total - at) * (empty + count)
    return cost / ((schedule.total - step) * (empty + crowd.present))


_LOG = logging.getLogger(__name__)
#: Minimum number of timed steps at the start, and minimum number of steps between two later time
#: measurements.
PROBE_STEPS = 12
#: Minimum share of the time budget that the timed steps at the start use.
PROBE_SHARE = 0.01
#: Kernels may be compiled during the timed steps. After a compilation, the timed steps are
#: restarted, at most this number of times.
_TRIES = 8
#: Minimum share of the time budget between two time measurements.
LOOK_SHARE = 0.02
#: The length is changed only if the difference exceeds this share of the remaining steps.
TOLERANCE = 0.02
#: `_NEVER` is a step number that no run reaches. From step `_FULL_SIZE` on, photos always have
#: their full size.
_NEVER = 10**9
_FULL_SIZE = _NEVER - _NEVER // 100
#: Weight of the newest measurement in the smoothed cost of a step. Smoothing is needed because
#: views differ in cost and other programs may slow down the machine.
SMOOTHING = 0.25


def steps_for(setup: Setup, seconds: float) -> tuple[int, str, float]:
    """Measure how many steps fit into `seconds` of training, on the clock that the run uses.

    All kernels must have been compiled before. The measured steps train a temporary model, which is
    discarded.

    Returns:
        The number of steps, a note that describes the measurement, and the measured `pixel_share`.
    """
    _LOG.info("timing a few steps to plan %g s of training", seconds)
    probed = replace(unwatched(setup), schedule=_without_edits(setup.schedule))
    state, pace, share = first_state(unwatched(setup)), setup.schedule.pace, setup.pixel_share
    state.step = _FULL_SIZE
    steps, seconds_per_step = _probed(probed, state, seconds)
    note = f"{steps} probed steps took {seconds_per_step * pace.at(_FULL_SIZE) * 1000:.1f} ms each"
    crowd = PrimitiveCounts.of(setup, state)

    def fitting(share: float) -> int:
        measured = replace(setup, pixel_share=share)
        return _fitting(
            lambda steps: cost_of_run(measured, crowd, steps), seconds / seconds_per_step
        )

    # The number of steps can affect the image resolution of the first steps.
    fits = fitting(share)
    first = _without_edits(schedule_for(setup, fits), max(fits, 2 * PROBE_STEPS))
    pixels = setup.selection.resolution.pixels(first, PROBE_STEPS) / first.pace.views(PROBE_STEPS)
    if pixels < 1.0:
        # Start from a new state, because the old state has already recorded full-size views.
        del state
        state = first_state(unwatched(setup))
        steps, small = _probed(replace(probed, schedule=first), state, seconds)
        note += f" at full size, {steps} at first {small * first.pace.at(1) * 1000:.1f} ms"
        share = min(1.0, max(0.0, (1.0 - small / seconds_per_step) / (1.0 - pixels)))
        fits = fitting(share)
    total = min(fits, most_steps(setup))
    if total < fits:
        note += f", of which {fits} fit into that time; the limit on views allows {total}"
    unit = " of CPU time" if setup.config.clock == "cpu" else ""
    text = f"{total} steps planned for {seconds:g} s{unit}: {note}; "
    return total, f"{text}the number of steps is adapted during the run", share


def most_steps(setup: Setup) -> int:
    """Return the largest number of steps that a run with a time budget may have."""
    views = setup.config.max_views
    return _NEVER if views is None else setup.selection.views.steps_of(views)


def _probed(setup: Setup, state: TrainState, seconds: float) -> tuple[int, float]:
    """Return the number of measured steps, and the training time per view in seconds.

    The measurement always repeats the same `PROBE_STEPS` steps, because later steps may render more
    pixels.

    If a kernel is compiled, the measurement restarts. The number of restarts is limited, because a
    plugin may compile kernels in every step.
    """
    kind, step, compiled, tries = setup.config.clock, state.step, False, _TRIES
    timed_step(setup, state)

    def begin_again(**_: bool) -> None:
        nonlocal compiled
        compiled = True

    start, count, taken = state.clock.copy(), 0, 0.0
    with notes_on_missing(begin_again):
        while count < PROBE_STEPS or taken < PROBE_SHARE * seconds:
            state.step = step + count % PROBE_STEPS
            timed_step(setup, state)
            count += 1
            if compiled and tries:
                start, count, compiled, tries = state.clock.copy(), 0, False, tries - 1
            taken = state.clock.trained(kind) - start.trained(kind)
    pace = setup.schedule.pace
    rounds, rest = divmod(count, PROBE_STEPS)
    views = [pace.views(step + steps) - pace.views(step) for steps in (PROBE_STEPS, rest)]
    return count, taken / (rounds * views[0] + views[1])


class Length(Protocol):
    """A rule that changes the number of steps of a run during training."""

    def due(self, state: TrainState) -> bool:
        """Return True if the number of steps must be decided again after this step."""
        ...

    def revised(self, setup: Setup, state: TrainState) -> Setup:
        """Return the setup with the number of steps that is valid from this step on."""
        ...


class Planned:
    """A length from a record.

    The length is fixed, or changes at the steps at which it changed in an earlier run.

    Args:
        revisions: Pairs of a step and the total number of steps that is valid after this step.
    """

    def __init__(self, revisions: tuple[tuple[int, int], ...] = ()) -> None:
        self._revisions = dict(revisions)

    def due(self, state: TrainState) -> bool:
        """Return True at the recorded steps."""
        return state.step in self._revisions

    def revised(self, setup: Setup, state: TrainState) -> Setup:
        """Return the setup with the recorded length."""
        return _told(setup, with_length(setup, state.step, self._revisions[state.step]))


class Timed:
    """A length that fits into a budget of training seconds.

    Args:
        seconds: The time budget, in seconds.
        kind: The clock that measures the time budget.
        most: Largest number of steps of the run, even if steps are fast.
    """

    def __init__(self, seconds: float, kind: ClockKind = "wall", *, most: int = _NEVER) -> None:
        self._seconds = seconds
        self._kind = kind
        self._most = most
        self._step = 0
        self._clock = 0.0
        self._each: float | None = None
        self._rewinds = self._seen = self._next = 0

    def due(self, state: TrainState) -> bool:
        """Return True after at least `PROBE_STEPS` steps and a minimum share of the time budget."""
        if state.rewinds > self._rewinds:
            # After a rollback, do not revise the length at a step that has been revised before. A
            # run records only one length for each step.
            self._rewinds, self._next = state.rewinds, self._seen + 1
            self._look(state)
        self._seen = state.step
        seconds = state.clock.trained(self._kind) - self._clock
        steps = 0 if state.step < self._next else state.step - self._step
        return steps >= PROBE_STEPS and seconds >= LOOK_SHARE * self._seconds

    def revised(self, setup: Setup, state: TrainState) -> Setup:
        """Return the setup with the number of steps that now fits.

        The configuration records this number.
        """
        # Measure the cost per view, because the number of views per step may change.
        seconds = state.clock.trained(self._kind) - self._clock
        newest = seconds / views_of(setup, setup.schedule, self._step, state.step)
        before = newest if self._each is None else self._each
        self._each = seconds_per_view = before + SMOOTHING * (newest - before)
        self._look(state)
        affordable = (self._seconds - state.clock.trained(self._kind)) / seconds_per_view
        crowd, step = PrimitiveCounts.of(setup, state), state.step
        fits = step + _fitting(lambda left: cost_ahead(setup, crowd, step, left), affordable)
        total = min(fits, self._most)
        if abs(total - setup.schedule.total) <= TOLERANCE * (setup.schedule.total - state.step):
            return setup
        revisions = (*setup.config.revisions, (state.step, total))
        revised = (*setup.config.revised, dict(setup.following(total, crowd.start)))
        update = {"revisions": revisions, "revised": revised}
        config = setup.config.model_copy(update=update)
        return _told(setup, with_length(replace(setup, config=config), state.step, total))

    def _look(self, state: TrainState) -> None:
        self._step, self._clock = state.step, state.clock.trained(self._kind)


def seconds_ahead(setup: Setup, state: TrainState, each: float) -> float:
    """Return the expected training seconds of the remaining steps.

    The estimate includes the cost of added primitives.

    Args:
        setup: The run.
        state: The present training state.
        each: Present duration of a step, in seconds.
    """
    schedule, step = setup.schedule, state.step
    now = views_of(setup, schedule, max(0, step - 1), max(1, step))
    steps = views_of(setup, schedule, step, schedule.total) / now
    return steps * each * growth_ahead(setup, PrimitiveCounts.of(setup, state), schedule, step)


def with_length(setup: Setup, step: int, total: int) -> Setup:
    """Return the setup of a run whose total number of steps changes to `total` at step `step`."""
    changed = zip(setup.config.revisions, setup.config.revised, strict=False)
    settings = {done: settings for (done, _), settings in changed}.get(step, {})
    setup = replace(setup, revised={**setup.revised, **settings})
    wanted = schedule_for(setup, total)
    setup.hook.crossgrad_length_changed(step=step, total=total)
    schedule = setup.schedule.with_length(wanted, step)
    return _with_notes(replace(setup, schedule=schedule), instead_of=setup)


def replay_length(setup: Setup, step: int) -> Setup:
    """Return the setup with all changes of the length that the run recorded up to `step`."""
    for done, total in setup.config.revisions:
        if done <= step:
            setup = with_length(setup, done, total)
    return setup


def _with_notes(setup: Setup, instead_of: Setup) -> Setup:
    """Replace the notes about the old length by notes about the new length."""
    gone = {*notes_on_length(instead_of), *_length_note(instead_of)}
    kept = (note for note in setup.notes if note not in gone)
    return replace(setup, notes=(*kept, *notes_on_length(setup), *_length_note(setup)))


def _length_note(setup: Setup) -> tuple[str, ...]:
    planned, total = setup.config.steps, setup.schedule.total
    if planned is None or planned == total:
        return ()
    return (
        (f"the number of steps was adapted to the time budget: {total} steps instead of {planned}"),
    )


def _told(before: Setup, after: Setup) -> Setup:
    """Return the setup `after`.

    Log a message if the new length switches density control on or off.
    """
    was, now = growth_note(before), growth_note(after)
    if was and not now:
        schedule = after.schedule
        start, end = map(schedule.step_of, (schedule.densify_from, schedule.densify_until))
        text = (
            f"density control is used after all: in a run of {schedule.total} steps it "
            "acts from step "
        )
        before.hook.crossgrad_log(text=f"{text}{start} to step {min(end, schedule.total)}")
    elif now and not was:
        before.hook.crossgrad_log(text=now[0])
    return after


def _without_edits(schedule: Schedule, total: int = _NEVER) -> Schedule:
    """Return a schedule for timing: statistics, all SH bands and all levels, but no edits."""
    return replace(
        schedule,
        total=total,
        sh_from=3,
        coarse_until=0,
        densify_from=0,
        densify_until=schedule.counted(_NEVER),
        densify_every=_NEVER,
        reset_every=None,
    )


def _fitting(cost: Callable[[int], float], affordable: float) -> int:
    """Return the largest number of steps that costs at most `affordable`; the result is at least 1.

    Args:
        cost: Function from a number of steps to the expected cost in full-size views; must
            increase.
        affordable: Largest allowed cost, in full-size views.
    """
    fits, too_many = 1, max(2, ceil(affordable) + 1)
    # The first upper limit may be too small, because small views cost less than full-size views.
    while cost(too_many) <= affordable and too_many < _NEVER:
        too_many *= 2
    while too_many - fits > 1:
        steps = (fits + too_many) // 2
        if cost(steps) <= affordable:
            fits = steps
        else:
            too_many = steps
    return fits

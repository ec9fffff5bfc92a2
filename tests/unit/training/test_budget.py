"""How many steps fit into a budget of training seconds."""

from dataclasses import dataclass, field, replace
from functools import partial
from types import SimpleNamespace

import pytest

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.densifier import Densifier
from crossgrad_core.contract.schedule import Schedule
from crossgrad_core.registry.entries import build
from crossgrad_core.training.budget import (
    Planned,
    Timed,
    _cost,
    _fitting,
    _without_edits,
    caught_up,
    lengthened,
)
from crossgrad_core.training.clock import Clock
from crossgrad_core.training.schedules import growth_note


class Hook:
    """Keeps what the run says."""

    def __init__(self):
        self.lengths, self.texts = [], []

    def crossgrad_length(self, step, total):
        self.lengths.append((step, total))

    def crossgrad_message(self, text):
        self.texts.append(text)


@dataclass(frozen=True)
class Run:
    """What of a setup decides about its length."""

    config: RunConfig
    densifier: Densifier
    selection: SimpleNamespace
    schedule: Schedule
    hook: Hook = field(default_factory=Hook)
    notes: tuple[str, ...] = ("a note on the scene",)


def setup(densifier="adc", steps=1000, mode="scaled"):
    return Run(
        RunConfig(steps=steps, schedule=mode),
        build("densifiers", densifier, {}),
        SimpleNamespace(names={"densifier": densifier}),
        Schedule.for_run(steps, mode),
    )


@pytest.mark.parametrize(
    ("affordable", "steps"),
    [
        (0.3, 1),
        (400.0, 400),  # too short for density control: nothing grows
        (1250.0, 1201),  # the longest run that does not grow
        (1500.0, 1250),  # one edit: every step costs 1.2 times as much
        (18_000.0, 9000),  # twice as much at the most
    ],
)
def test_growth_is_paid_for_only_where_it_happens(affordable, steps):
    assert _fitting(partial(_cost, setup()), affordable) == steps


@pytest.mark.parametrize(
    ("affordable", "steps"),
    [(400.0, 400), (599.0, 599), (1200.0, 799), (18_000.0, 9000)],
)
def test_edits_that_a_run_never_reaches_cost_nothing(affordable, steps):
    run = setup(mode="absolute")
    assert _fitting(partial(_cost, run), affordable) == steps
    assert bool(growth_note(setup(steps=steps, mode="absolute"))) == (steps < 600)


@pytest.mark.parametrize("mode", ["scaled", "absolute"])
def test_probed_steps_have_statistics_all_bands_and_levels_and_no_edits(mode):
    schedule = _without_edits(Schedule.for_run(12_000, mode))
    steps = range(1, 12_001)
    assert all(schedule.collects(step) for step in steps)
    assert not any(schedule.densifies(step) or schedule.resets(step) for step in steps)
    assert schedule.sh_degree(3) == 3
    assert schedule.coarse_until == 0 == schedule.densify_from


def test_without_density_control_every_step_costs_the_same():
    assert _fitting(partial(_cost, setup("none")), 18_000.0) == 18_000


def timed(seconds, planned, cost):
    """A run whose step s takes cost(s, schedule) seconds, and its clock at the end."""
    run, state = setup(steps=planned), SimpleNamespace(step=0, rewinds=0, clock=Clock())
    length = Timed(seconds)
    while state.step < run.schedule.total:
        state.step += 1
        state.clock.train += cost(state.step, run.schedule)
        if state.step < run.schedule.total and length.due(state):
            run = length.revised(run, state)
    return run, state.clock.train


def grown(step, schedule):
    """Eight times as many primitives at the end of density control."""
    share = (step - schedule.densify_from) / (schedule.densify_until - schedule.densify_from)
    return 0.02 * (1.0 + 7.0 * min(1.0, max(0.0, share)))


@pytest.mark.parametrize(
    ("planned", "cost"),
    [
        (1500, lambda step, schedule: 0.04),  # four times too short
        (12_000, lambda step, schedule: 0.04),
        (3000, grown),
        (3000, lambda step, schedule: 0.02 if step < 1000 else 0.06),  # others use the machine
        (3000, lambda step, schedule: 0.06 if step < 1000 else 0.02),
    ],
)
def test_a_budget_is_met_whatever_the_probe_said(planned, cost):
    run, seconds = timed(140.0, planned, cost)
    assert seconds == pytest.approx(140.0, rel=0.01)
    assert run.schedule.total == run.schedule.lr_until
    assert run.notes == (
        "a note on the scene",
        f"the length followed the clock: {run.schedule.total} steps instead of {planned}",
    )


def test_a_budget_that_is_used_up_ends_the_run():
    _, seconds = timed(10.0, 1000, lambda step, schedule: 1.0)
    assert seconds == 13.0  # the first look is after twelve steps


def test_the_written_lengths_repeat_the_schedule_of_every_step():
    run, _ = timed(140.0, 3000, grown)
    revisions = run.config.revisions
    assert list(revisions) == run.hook.lengths
    start = replace(run, schedule=Schedule.for_run(3000))
    assert caught_up(start, 10**9).schedule == run.schedule
    step = revisions[3][0]
    assert caught_up(start, step - 1).schedule.total == revisions[2][1]
    assert caught_up(start, step).schedule.total == revisions[3][1]


def test_a_length_that_fits_stays():
    run, _ = timed(140.0, 1000, lambda step, schedule: 0.14)
    assert run.config.revisions == ()
    assert run.schedule == Schedule.for_run(1000)
    assert run.notes == ("a note on the scene",)


def noted(run):
    """The run with its note on density control, as `app.run` starts it."""
    return replace(run, notes=(*run.notes, *growth_note(run)))


def growth_notes(run):
    return [note for note in run.notes if "density control" in note]


def test_notes_that_the_clock_overtakes_are_withdrawn():
    run = noted(setup(steps=935))
    assert len(growth_notes(run)) == 1
    longer = lengthened(run, 100, 3000)
    assert growth_notes(longer) == []
    assert longer.notes[-1] == "the length followed the clock: 3000 steps instead of 935"
    shorter = lengthened(longer, 200, 900)
    assert growth_notes(shorter) == list(growth_note(shorter)) != []
    assert shorter.notes[-1] == "the length followed the clock: 900 steps instead of 935"
    back = lengthened(shorter, 300, 935)
    assert back.notes == run.notes


@pytest.mark.parametrize("length", [Timed(140.0), Planned(((20, 3000),))], ids=["timed", "planned"])
def test_the_user_is_told_once_that_density_control_takes_place_after_all(length):
    run, state = noted(setup(steps=935)), SimpleNamespace(step=0, rewinds=0, clock=Clock())
    while state.step < run.schedule.total:
        state.step += 1
        state.clock.train += 0.04
        if state.step < run.schedule.total and length.due(state):
            run = length.revised(run, state)
    assert growth_notes(run) == []
    (text,) = run.hook.texts
    assert text.startswith("density control after all: in ") and "from step 500 to step" in text


def test_the_user_is_told_where_density_control_is_left_out_later():
    run = noted(setup(steps=3000))
    Planned(((20, 900),)).revised(run, SimpleNamespace(step=20))
    assert run.hook.texts == list(growth_note(setup(steps=900)))


def test_the_user_is_told_of_no_step_behind_the_end():
    run = noted(setup(steps=550, mode="absolute"))
    Planned(((20, 700),)).revised(run, SimpleNamespace(step=20))
    assert run.hook.texts[0].endswith("in 700 steps it lasts from step 500 to step 700")

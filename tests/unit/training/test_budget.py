"""The number of steps that fit into a budget of training seconds."""

from dataclasses import dataclass, field, replace
from functools import partial
from types import SimpleNamespace

import pytest

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.blocks import Block
from crossgrad_core.contract.schedule import Schedule
from crossgrad_core.contract.slots.densifier import Densifier
from crossgrad_core.registry.entries import build
from crossgrad_core.run.assemble import assemble
from crossgrad_core.run.decisions import with_decisions
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training import budget
from crossgrad_core.training.budget import (
    Planned,
    PrimitiveCounts,
    Timed,
    _fitting,
    _without_edits,
    cost_of_run,
    growth_ahead,
    replay_length,
    seconds_ahead,
    steps_for,
    with_length,
)
from crossgrad_core.training.growth_budget import curve
from crossgrad_core.training.numbers import Numbers
from crossgrad_core.training.schedules import growth_note
from crossgrad_core.training.state import Clock
from crossgrad_plugins.recipes.budget import budget as default_budget


class Hook:
    """Keeps what the run says."""

    def __init__(self):
        self.lengths, self.texts = [], []

    def crossgrad_length_changed(self, step, total):
        self.lengths.append((step, total))

    def crossgrad_log(self, text):
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
    pixel_share: float = 0.6
    revised: dict = field(default_factory=dict)
    trained_blocks: tuple[Block, ...] = ()

    @property
    def in_force(self):
        return self.config

    @property
    def numbers(self):
        return Numbers.of(self.config)

    def following(self, steps, start):
        return {}

    def at_length(self, steps, start):
        return self


def setup(densifier="adc", steps=1000, mode="scaled", resolution="full"):
    config = RunConfig(
        steps=steps, schedule=mode, schedule_unit="steps", densifier={"name": densifier}
    )
    return Run(
        with_decisions(config, sample_scene())[0],
        build("densifiers", densifier, {}),
        SimpleNamespace(
            names={"densifier": densifier},
            resolution=build("resolutions", resolution, {}).fitted_to(sample_scene()),
        ),
        Schedule.for_run(steps, mode),
    )


#: As many primitives as at the start.
CROWD = PrimitiveCounts(start=1000, present=1000)


def reached(step, present=1000):
    """What of a state decides about a length."""
    return SimpleNamespace(
        step=step, rewinds=0, clock=Clock(), states={}, primitives=lambda setup: present
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
def test_the_cost_of_growth_counts_only_while_primitives_grow(affordable, steps):
    assert _fitting(partial(cost_of_run, setup(), CROWD), affordable) == steps


@pytest.mark.parametrize(
    ("affordable", "steps"),
    [(400.0, 400), (599.0, 599), (1200.0, 799), (18_000.0, 9000)],
)
def test_edits_after_the_end_of_a_run_cost_nothing(affordable, steps):
    run = setup(mode="absolute")
    assert _fitting(partial(cost_of_run, run, CROWD), affordable) == steps
    assert bool(growth_note(setup(steps=steps, mode="absolute"))) == (steps < 600)


@pytest.mark.parametrize("mode", ["scaled", "absolute"])
def test_speed_probe_steps_use_all_sh_bands_and_levels_without_edits(mode):
    schedule = _without_edits(Schedule.for_run(12_000, mode))
    steps = [*range(1, 12_001), budget._FULL_SIZE + 1, budget._FULL_SIZE + budget.PROBE_STEPS]
    assert all(schedule.collects(step) for step in steps)
    assert not any(schedule.densifies(step) or schedule.resets(step) for step in steps)
    assert schedule.sh_degree(3) == 3
    assert schedule.coarse_until == 0 == schedule.densify_from


@pytest.mark.sampled(4)
@pytest.mark.parametrize("views", ["1", "3", "1..2@0.5"])
@pytest.mark.parametrize("name", ["full", "octaves", "strided"])
def test_speed_probe_steps_collect_statistics_and_use_all_sh_bands(monkeypatch, name, views):
    settings = {"seconds": 10.0, "resolution": {"name": "full"}, "views_per_step": views}
    run = assemble(RunConfig.model_validate(settings), sample_scene(), "none")
    resolution = GROWING.get(name, run.selection.resolution)
    run = replace(run, selection=replace(run.selection, resolution=resolution))
    taken = []

    def step(setup, state):
        state.step += 1
        state.clock.train += 0.01
        assert setup.schedule.collects(state.step)
        assert setup.schedule.sh_degree(state.step) == 3
        assert not setup.schedule.densifies(state.step)
        taken.append(state.step)

    monkeypatch.setattr(budget, "timed_step", step)
    steps_for(run, 10.0)
    # Samplers that take turns have all of them.
    assert {each % 2 for each in taken} == {0, 1}


def along_the_curve(steps, start):
    """A run whose growth follows the curve, on the sample scene."""
    run = assemble(RunConfig(steps=steps, views=2), sample_scene(), "none")
    return run, PrimitiveCounts(start, start)


def test_growth_along_the_budget_curve_costs_the_primitives_that_it_adds():
    run, crowd = along_the_curve(1000, 30_000)
    camera = run.train_views[0].camera
    empty = camera.width * camera.height / 8.0
    budget = default_budget(30_000, 2000)
    ends = [*run.schedule.edit_steps(), 1000]
    edits = run.schedule.edits()
    assert edits == len(ends) - 1 > 5
    counts = [30_000, *(curve(edit, edits, 30_000, budget) for edit in range(1, edits + 1))]
    steps = [end - start for start, end in zip([0, *ends], ends, strict=False)]
    mean = sum(n * (empty + count) for n, count in zip(steps, counts, strict=True)) / 1000
    assert growth_ahead(run, crowd, run.schedule, 0) == pytest.approx(mean / (empty + 30_000))
    # What was not added is not counted on: half-way the run has fewer than the curve allows.
    behind = growth_ahead(run, PrimitiveCounts(30_000, 31_000), run.schedule, ends[-4])
    left = zip(steps[-3:], [31_000, *counts[-2:]], strict=True)
    mean = sum(n * (empty + count) for n, count in left) / sum(steps[-3:])
    assert behind == pytest.approx(mean / (empty + 31_000))


def test_growth_to_a_budget_costs_at_most_the_cost_of_unbounded_growth():
    run, _ = along_the_curve(2000, 1)
    assert growth_ahead(run, PrimitiveCounts(1, 1), run.schedule, 0) == 2.0


def test_every_step_costs_the_same_after_density_control_has_ended():
    run, _ = along_the_curve(2000, 30_000)
    assert growth_ahead(run, PrimitiveCounts(30_000, 60_000), run.schedule, 1000) == 1.0


def test_every_step_costs_the_same_without_density_control():
    assert _fitting(partial(cost_of_run, setup("none"), CROWD), 18_000.0) == 18_000


def timed(seconds, planned, cost, **of_setup):
    """A run whose step s takes cost(s, schedule) seconds, and its clock at the end."""
    run = setup(steps=planned, **of_setup)
    state = reached(0)
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
def test_a_time_budget_is_met_even_if_the_speed_probe_was_wrong(planned, cost):
    run, seconds = timed(140.0, planned, cost)
    assert seconds == pytest.approx(140.0, rel=0.01)
    assert run.schedule.total == run.schedule.lr_until
    assert run.notes == (
        "a note on the scene",
        "the number of steps was adapted to the time budget: "
        f"{run.schedule.total} steps instead of {planned}",
    )


@pytest.mark.parametrize(("each", "steps"), [(0.01, 3000), (0.04, 2334), (0.08, 1168)])
def test_a_run_ends_at_its_time_budget_or_its_step_limit_whichever_comes_first(each, steps):
    run, state, length = setup(steps=3000), reached(0), Timed(93.33, most=3000)
    while state.step < run.schedule.total:
        state.step += 1
        state.clock.train += each
        if state.step < run.schedule.total and length.due(state):
            run = length.revised(run, state)
    assert run.schedule.total == pytest.approx(steps, rel=0.01)
    assert bool(run.config.revisions) == (steps < 3000)
    assert all(total <= 3000 for _, total in run.config.revisions)


def test_a_used_up_time_budget_ends_the_run():
    _, seconds = timed(10.0, 1000, lambda step, schedule: 1.0)
    assert seconds == 13.0  # the first look is after twelve steps


def test_the_recorded_lengths_reproduce_the_schedule_at_every_step():
    run, _ = timed(140.0, 3000, grown)
    revisions = run.config.revisions
    assert list(revisions) == run.hook.lengths
    start = replace(run, schedule=Schedule.for_run(3000))
    assert replay_length(start, 10**9).schedule == run.schedule
    step = revisions[3][0]
    assert replay_length(start, step - 1).schedule.total == revisions[2][1]
    assert replay_length(start, step).schedule.total == revisions[3][1]


def test_a_length_that_fits_the_budget_is_kept():
    run, _ = timed(140.0, 1000, lambda step, schedule: 0.14)
    assert run.config.revisions == ()
    assert run.schedule == Schedule.for_run(1000)
    assert run.notes == ("a note on the scene",)


def noted(run):
    """The run with its note on density control, as `app.run` starts it."""
    return replace(run, notes=(*run.notes, *growth_note(run)))


def growth_notes(run):
    return [note for note in run.notes if "density control" in note]


def test_notes_that_a_new_length_makes_wrong_are_withdrawn():
    run = noted(setup(steps=935))
    assert len(growth_notes(run)) == 1
    longer = with_length(run, 100, 3000)
    assert growth_notes(longer) == []
    assert (
        longer.notes[-1]
        == "the number of steps was adapted to the time budget: 3000 steps instead of 935"
    )
    shorter = with_length(longer, 200, 900)
    assert growth_notes(shorter) == list(growth_note(shorter)) != []
    assert (
        shorter.notes[-1]
        == "the number of steps was adapted to the time budget: 900 steps instead of 935"
    )
    back = with_length(shorter, 300, 935)
    assert back.notes == run.notes


@pytest.mark.parametrize("length", [Timed(140.0), Planned(((20, 3000),))], ids=["timed", "planned"])
def test_a_note_reports_once_that_density_control_becomes_active(length):
    run, state = noted(setup(steps=935)), reached(0)
    while state.step < run.schedule.total:
        state.step += 1
        state.clock.train += 0.04
        if state.step < run.schedule.total and length.due(state):
            run = length.revised(run, state)
    assert growth_notes(run) == []
    (text,) = run.hook.texts
    assert (
        text.startswith("density control is used after all: in ")
        and "from step 500 to step" in text
    )


def test_a_note_reports_that_a_shorter_length_disables_density_control():
    run = noted(setup(steps=3000))
    Planned(((20, 900),)).revised(run, reached(20))
    assert run.hook.texts == list(growth_note(setup(steps=900)))


def test_the_note_on_density_control_names_no_step_after_the_end():
    run = noted(setup(steps=550, mode="absolute"))
    Planned(((20, 700),)).revised(run, reached(20))
    assert run.hook.texts[0].endswith("in a run of 700 steps it acts from step 500 to step 700")


#: Scales that grow, as far as a budget sees them: photos large enough for all of them.
COURSES = {"all": {"photos": 9, "scales": [0.25] * 16 + [0.3 + 0.04 * n for n in range(16)]}}
GROWING = {
    "octaves": build("resolutions", "octaves", {}),
    "spectral": build("resolutions", "spectral", {"courses": COURSES}),
    "strided": build("resolutions", "strided", {"coarsest": 4}),
}


def with_pixels(resolution, base=0.01, each=0.03):
    """What a step takes of which so much goes with its pixels."""

    def cost(step, schedule):
        pixels = [resolution.pixels(schedule, taken) for taken in (step - 1, step)]
        return base + each * (pixels[1] - pixels[0])

    return cost


@pytest.mark.parametrize("name", GROWING)
def test_the_planned_length_includes_the_growing_photo_size(name):
    run, seconds, cost = setup("none"), 60.0, with_pixels(GROWING[name])
    run.selection.resolution = GROWING[name]
    run = replace(run, pixel_share=0.75)
    planned = _fitting(partial(cost_of_run, run, CROWD), seconds / 0.04)
    assert planned > 1.2 * seconds / 0.04
    run = replace(run, schedule=Schedule.for_run(planned))
    state, length = reached(0), Timed(seconds)
    while state.step < run.schedule.total:
        state.step += 1
        state.clock.train += cost(state.step, run.schedule)
        if state.step < run.schedule.total and length.due(state):
            run = length.revised(run, state)
    assert state.clock.train == pytest.approx(seconds, rel=0.01)
    # The clock has next to nothing to correct: no rate or scale was chosen for another length.
    assert abs(run.schedule.total - planned) < 0.03 * planned
    assert len(run.config.revisions) <= 2


def test_future_steps_cost_more_if_photos_become_larger():
    run = replace(setup("none"), pixel_share=1.0, schedule=Schedule.for_run(100))
    run.selection.resolution = GROWING["octaves"]
    # 20 steps of 1/16, 20 of 1/4, 60 of all pixels.
    assert seconds_ahead(run, reached(10), 1.0) == pytest.approx(10 + 20 * 4 + 60 * 16)
    assert seconds_ahead(run, reached(50), 1.0) == pytest.approx(50)


@pytest.mark.sampled(4)
@pytest.mark.parametrize("views", ["1", "3", "1..2@0.5"])
@pytest.mark.parametrize("name", ["full", "octaves", "spectral", "strided"])
def test_the_speed_probe_separates_the_cost_per_pixel(monkeypatch, name, views):
    settings = {"seconds": 10.0, "resolution": {"name": "full"}, "views_per_step": views}
    run = assemble(RunConfig.model_validate(settings), sample_scene(), "none")
    resolution = GROWING.get(name, run.selection.resolution)
    run = replace(run, selection=replace(run.selection, resolution=resolution))
    rates = []

    def step(setup, state):
        state.step += 1
        now = with_pixels(resolution)(state.step, setup.schedule)
        views = setup.schedule.pace.at(state.step)
        state.clock.train += 0.01 * (views - 1) + now
        rates.append(now)

    monkeypatch.setattr(budget, "timed_step", step)
    total, note, share = steps_for(run, 10.0)
    assert (" at full size" in note) == (name != "full")
    assert share == pytest.approx(0.6 if name == "full" else 0.75)
    assert len(rates) == 13 + 13 * (name != "full")
    if views == "1" and name != "full":
        assert "12 probed steps took 40.0 ms each at full size, 12 at first 11.9 ms" in note
        assert total > 10.0 / 0.04


def test_reduced_photos_are_kept_when_the_length_changes():
    run = assemble(RunConfig(steps=400), sample_scene(), "none")
    run = replace(run, config=run.config.model_copy(update={"revisions": ((3, 500),)}))
    assert replay_length(run, 4).scaled_photos is run.scaled_photos


def test_the_note_on_render_scales_follows_the_current_length():
    settings = {"steps": 1000, "resolution": {"name": "octaves"}, "densifier": {"name": "none"}}
    run = assemble(RunConfig.model_validate(settings), sample_scene(), "none")
    told = [note for note in run.notes if note.startswith("resolution")]
    assert told == [octaves_note(200, 400)]
    config = run.config.model_copy(update={"revisions": ((3, 500), (9, 600))})
    longer = replay_length(replace(run, config=config), 20)
    told = [note for note in longer.notes if note.startswith("resolution")]
    assert told == [octaves_note(120, 240)]


def octaves_note(quarter, half):
    scales = f"1/4 to step {quarter}, 1/2 from step {quarter + 1}, full size from step {half + 1}"
    return f"resolution: {scales}; no side has fewer than 96 pixels"

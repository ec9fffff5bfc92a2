"""The budget of density control, and the curve that leads to it, for whatever grows."""

from dataclasses import replace
from fractions import Fraction
from math import floor
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from crossgrad_core.config import ComponentChoice, RunConfig
from crossgrad_core.contract.blocks import PluginState
from crossgrad_core.contract.schedule import Counting, Schedule, ViewsPerStepSpec
from crossgrad_core.run.assemble import assemble
from crossgrad_core.run.checkpoint import Keep, latest, load, save
from crossgrad_core.run.load_run import from_checkpoint, to_checkpoint
from crossgrad_core.run.resolve import resolved
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training import growth_budget
from crossgrad_core.training.growth_budget import curve
from crossgrad_core.training.loop import timed_step
from crossgrad_core.training.start import first_state, start_notes, thinned
from crossgrad_plugins.recipes import auto
from crossgrad_plugins.recipes import budget as budgets
from crossgrad_plugins.recipes.budget import budget as default_budget

#: Densifiers that want more than any curve gives them, and their backbones.
GREEDY = {
    "adc": {
        "grad_threshold": 1e-12,
        "prune_opacity": 0,
        "split_scale": 100,
        "division": "drawn",
    },
    "absgrad": {"grad_threshold": 1e-12, "abs_threshold": 1e-12, "prune_opacity": 0},
    "pixel": {"grad_threshold": 1e-12, "prune_opacity": 0},
    "dc4gs": {"split_threshold": 1e-12, "grad_threshold": 1e-12, "prune_opacity": 0},
    "revising": {"growth_budget": 1, "error_threshold": 1e-9, "prune_opacity": 0},
    "mcmc": {"growth": 1, "noise": 0, "dead_opacity": 1e-9},
    "anchor": {"success_threshold": 0, "coarsest": 1, "grad_threshold": 1e-12, "prune_opacity": 0},
    "octree": {"success_threshold": 0, "grad_threshold": 1e-12, "prune_opacity": 0},
}
BACKBONES = {
    "anchor": {"name": "scaffold", "voxel_size": 1e-5},
    "octree": {"name": "octree", "middle_cell": 1e-5},
}
EDITS = 4


def setup_of(densifier, **settings):
    """A run of 4 edits, after steps 2, 4, 6 and 8."""
    config = RunConfig(
        initializer={"name": "points"},
        steps=10, schedule_unit="steps", densify_from=1, densify_until=9, densify_every=2,
        densifier=ComponentChoice(name=densifier, **GREEDY[densifier]),
        backbone=ComponentChoice(**BACKBONES.get(densifier, {"name": "vanilla"})), **settings,
    )  # fmt: skip
    return assemble(config, sample_scene(), "none")


def counts_of(setup, steps=9):
    state = first_state(setup)
    return [state.primitives(setup), *(timed_step(setup, state).primitives for _ in range(steps))]


numbers = st.integers(0, 10**7)


@given(start=numbers, budget=numbers, events=st.integers(1, 500), share=st.floats(0, 1))
def test_the_growth_curve_is_the_published_curve(start, budget, events, share):
    event = round(share * events)
    a = Fraction(budget - start - 2 * events, events**2)
    assert curve(event, events, start, budget) == floor(a * event**2 + 2 * event + start)
    assert curve(0, events, start, budget) == start
    assert curve(events, events, start, budget) == budget


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", GREEDY)
def test_every_growing_densifier_follows_the_budget_curve(name):
    free = counts_of(setup_of(name))
    start = free[0]
    budget = start + (free[2] - start) // 2  # Less than the first edit alone would add.
    assert budget > start + EDITS
    found = counts_of(setup_of(name, max_gaussians=budget, growth="budget"))
    for edit in range(1, EDITS + 1):
        assert found[2 * edit] == curve(edit, EDITS, start, budget)
        assert found[2 * edit - 1] == found[2 * edit - 2]
    assert found[-1] == budget
    at_once = counts_of(setup_of(name, max_gaussians=budget, growth="unbounded"))
    assert at_once[2] == budget


def test_the_strongest_candidates_grow_first():
    """The growth curve leaves out the candidates that the densifier would add last."""
    found = {}
    for growth in ("unbounded", "budget"):
        setup = setup_of("adc", max_gaussians=60, growth=growth)
        state = first_state(setup)
        for _ in range(2):
            timed_step(setup, state)
        found[growth] = state.parameters["means"][40:].detach()
    some, many = found["budget"], found["unbounded"]
    assert 0 < len(some) < len(many)
    assert {tuple(row) for row in some.tolist()} <= {tuple(row) for row in many.tolist()}


@pytest.mark.parametrize(
    ("settings", "division"),
    [
        ({}, "axis"),
        ({"growth": "unbounded"}, "drawn"),
        ({"max_gaussians": 60}, "drawn"),
        ({"growth": "budget", "max_gaussians": 60}, "axis"),
        ({"recipe": {"name": "published"}}, "drawn"),
        ({"steps": 30_000, "growth": "budget"}, "drawn"),
    ],
)
def test_short_budgeted_runs_split_gaussians_along_their_long_axis(settings, division):
    config = RunConfig.model_validate({"steps": 2_000, **settings})
    setup = assemble(config, sample_scene(), "none")
    assert setup.densifier.division == division
    assert resolved(setup).densifier.options["division"] == division


def test_pruned_gaussians_free_room_for_growth():
    setup = setup_of("adc", max_gaussians=80, growth="budget")
    state = first_state(setup)
    for _ in range(3):
        timed_step(setup, state)
    few = {name: tensor[:10] for name, tensor in state.parameters.items()}
    state.parameters = {n: t.detach().clone().requires_grad_() for n, t in few.items()}
    state.adam = first_state(setup).adam
    state.states = {**state.states, "densifier": PluginState()}
    assert timed_step(setup, state).primitives == 20  # All are cloned: far from the curve.


@pytest.mark.sampled(7)
@pytest.mark.parametrize(
    ("settings", "growth", "bound"),
    [
        ({}, "budget", "auto"),
        ({"max_gaussians": "auto"}, "budget", "auto"),
        ({"max_gaussians": 60}, "unbounded", 60),
        ({"growth": "unbounded"}, "unbounded", 0),
        ({"growth": "unbounded", "max_gaussians": "auto"}, "unbounded", "auto"),
        ({"growth": "budget", "max_gaussians": 60}, "budget", 60),
        ({"schedule_unit": "steps"}, "unbounded", 0),
        ({"schedule_unit": "steps", "growth": "budget"}, "budget", "auto"),
        ({"recipe": {"name": "published"}}, "unbounded", 0),
        ({"schedule": "absolute"}, "unbounded", 0),
        ({"steps": 30_000}, "unbounded", 0),
        ({"densifier": {"name": "none"}}, "unbounded", 0),
        ({"densifier": {"name": "mcmc"}}, "unbounded", 0),
        ({"backbone": {"name": "scaffold"}}, "unbounded", 0),
        ({"backbone": {"name": "pixel"}}, "budget", "auto"),
    ],
)
def test_growth_and_budget_follow_the_settings(settings, growth, bound):
    """The resolved configuration contains the same values explicitly."""
    config = RunConfig.model_validate({"steps": 2_000, **settings})
    setup = assemble(config, sample_scene(), "none")
    assert (setup.numbers.growth, setup.numbers.max_gaussians) == (growth, bound)
    written = resolved(setup)
    assert (written.growth, written.max_gaussians) == (growth, bound)
    led = growth == "budget" and setup.schedule.counting.unit == "views"
    if setup.schedule.total < 30_000:
        assert setup.schedule.min_refinements == (6 if led else 0)
    shown = [row.setting for row in setup.decisions if row.override]
    assert ("growth" in shown) == (growth == "budget" and "growth" not in settings)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("growth", ["unbounded", "budget"])
@pytest.mark.parametrize("name", GREEDY)
def test_a_max_gaussians_below_the_number_of_points_leaves_room_for_growth(name, growth):
    whole = first_state(setup_of(name)).primitives(setup_of(name))
    bound = whole - 10
    setup = setup_of(name, max_gaussians=bound, growth=growth)
    found = counts_of(setup)
    # Of anchors the number follows that of points only about.
    about = 0 if name not in BACKBONES else 3
    assert found[0] == pytest.approx(2 * bound / 3, abs=0.5 + about)
    assert found[-1] == bound == max(found)
    (told,) = start_notes(setup, first_state(setup))
    assert f"{found[0]:,} Gaussians instead of {whole:,}" in told
    for enough in (whole, whole + 1, "auto", None):
        state = first_state(setup := setup_of(name, max_gaussians=enough))
        assert state.primitives(setup) == whole and start_notes(setup, state) == ()


def test_a_ply_start_above_max_gaussians_is_reported():
    state = first_state(setup_of("adc"))
    (told,) = start_notes(setup_of("adc", max_gaussians=30), state)
    assert "more than --max-gaussians 30: a file is used unchanged" in told


@pytest.mark.parametrize(
    "settings", [{"steps": 4}, {"steps": 2_000, "densifier": {"name": "none"}}]
)
def test_a_run_without_density_control_starts_with_max_gaussians(settings):
    config = RunConfig(initializer={"name": "points"}, max_gaussians=9, **settings)
    setup = assemble(config, sample_scene(), "none")
    assert first_state(setup).primitives(setup) == 9


def test_random_points_are_bounded_and_determined_by_the_seed():
    def means(seed):
        config = RunConfig(seed=seed, steps=4, max_gaussians=300, data={"init": "random"})
        return first_state(assemble(config, sample_scene(), "none")).parameters["means"]

    assert len(means(0)) == 300 and torch.equal(means(0), means(0))
    assert not torch.equal(means(0), means(1))


def test_random_points_ignore_the_indices_of_sfm_points():
    """The scene has more SfM points than random points, so views refer to large row numbers."""
    scene = sample_scene()
    rows = np.arange(30_000) % len(scene.points)
    views = tuple(replace(view, seen=np.array([29_999])) for view in scene.views)
    scene = replace(
        scene, views=views, points=scene.points[rows], point_colors=scene.point_colors[rows]
    )
    config = RunConfig(steps=4, max_gaussians=300, data={"init": "random"})
    setup = assemble(config, scene, "none")
    assert first_state(setup).primitives(setup) == 300


def test_max_gaussians_is_respected_if_many_points_form_one_anchor():
    scene = sample_scene()
    spread = np.random.default_rng(0).uniform(-1, 1, (4_000, 3))
    colors = np.zeros((4_000, 3), dtype=np.uint8)
    scene = replace(scene, points=spread, point_colors=colors)
    scene = replace(scene, views=tuple(replace(v, seen=np.arange(9)) for v in scene.views))
    wide = {"name": "scaffold", "voxel_size": 0.4}
    config = RunConfig(steps=4, initializer={"name": "points"}, backbone=wide)
    whole = first_state(setup := assemble(config, scene, "none")).primitives(setup)
    assert whole < 400  # Ten points and more in each.
    config = RunConfig(
        steps=4, initializer={"name": "points"}, backbone=wide, max_gaussians=whole // 2
    )
    setup = assemble(config, scene, "none")
    assert 0 < first_state(setup).primitives(setup) <= whole // 2


def test_points_added_by_an_initializer_are_kept_if_they_fit_the_bound():
    scene = sample_scene()
    count = len(scene.points)
    sizes = np.full(count, np.nan)
    sizes[[3, count - 1]] = 0.5
    scene = replace(scene, point_sizes=sizes, point_opacities=sizes)
    for wanted, kept in ((5, 2), (2, None)):
        few = thinned(scene, wanted / count, np.random.default_rng(0))
        assert len(few.points) == len(few.point_colors) == len(few.point_sizes) == wanted
        if kept is not None:
            assert int(np.isfinite(few.point_sizes).sum()) == kept
        for view, before in zip(few.views, scene.views, strict=True):
            there = {tuple(each) for each in scene.points[before.seen]}
            mine = {tuple(each) for each in few.points[view.seen]}
            assert mine == there & {tuple(each) for each in few.points}
    assert len(thinned(scene, 1e-9, np.random.default_rng(0)).points) == 1


@pytest.mark.parametrize("growth", ["unbounded", "budget"])
def test_the_automatic_budget_suits_the_length(growth, monkeypatch):
    monkeypatch.setattr(budgets, "SHORT_BUDGET", 50)
    found = counts_of(setup_of("adc", max_gaussians="auto", growth=growth))
    assert found[-1] == 50 == max(found)
    assert (found[2] == 50) == (growth == "unbounded")


def test_the_default_budget_grows_with_the_length():
    assert [default_budget(20_000, length) for length in (1, 300, 1_000)] == [
        30_001,
        30_303,
        31_034,
    ]
    assert default_budget(20_000, 10_000) == 150_000
    starts = (0, 5_000, 7_000, 15_000, 16_000, 30_000, 31_000)
    budgets = [default_budget(start, 0) for start in starts]
    assert budgets == [10_000, 10_000, 14_000, 30_000, 30_000, 30_000, 31_000]
    assert default_budget(90_000, 1_000) == 93_103
    assert default_budget(90_000, 10_000) == 450_000
    # Towards the published length, which has no bound, the budget stays a number of Gaussians.
    assert default_budget(20_000, 27_000) < default_budget(20_000, 29_999) < 2_000_000
    assert default_budget(20_000, 30_000) == 0
    # Photos of up to 400 x 300 pixels have the same; a scene with few points has no time for more.
    assert (
        default_budget(90_000, 1_000, 119_000) == default_budget(90_000, 1_000, 120_000) == 93_103
    )
    assert default_budget(90_000, 1_000, 480_000) == pytest.approx(90_000 * 30 / 29 * 4**0.4, abs=1)
    assert default_budget(20_000, 1_000, 480_000) == pytest.approx(30_000 * 30 / 29 * 4**0.4, abs=1)
    assert default_budget(14_000, 1_000, 480_000) == default_budget(14_000, 1_000)
    # In longer runs less, by the logarithm of the length.
    finer = [
        default_budget(90_000, n, 480_000) / default_budget(90_000, n) for n in (9_487, 29_999)
    ]
    assert finer == [pytest.approx(4**0.2, rel=1e-4), pytest.approx(1.0, rel=1e-4)]
    # And more in runs with few passes, where large photos count as those that were measured.
    few_passes = [
        default_budget(90_000, 1_000, n, few_passes=True) for n in (119_000, 240_000, 480_000)
    ]
    assert few_passes == pytest.approx([n * 90_000 * 30 / 29 for n in (1, 2**0.9, 4**0.9)], abs=1)
    twelve = [default_budget(90_000, 1_000, 12_000_000, few_passes=each) for each in (False, True)]
    assert twelve[1] == pytest.approx(twelve[0] * 2, abs=2)
    lengths = range(1_000, 27_001, 500)
    for few_passes in (False, True):
        budgets = [
            default_budget(30_000, length, 480_000, few_passes=few_passes) for length in lengths
        ]
        assert budgets == sorted(set(budgets))


@pytest.mark.parametrize(("settings", "more"), [({}, 2), ({"beta2": 0.999}, 1)])
def test_runs_with_few_passes_over_large_photos_have_a_larger_budget(settings, more, monkeypatch):
    monkeypatch.setattr(budgets, "SHORT_BUDGET", 50)
    setup = setup_of("adc", growth="budget", max_gaussians="auto", **settings)
    monkeypatch.setattr(budgets, "PIXELS", setup.scene.train_pixels / 4)
    monkeypatch.setattr(budgets, "FEW_PASSES_PIXELS", setup.scene.train_pixels)
    monkeypatch.setattr(budgets, "FINER", 0.0)
    assert growth_budget.most_after(setup, setup.schedule, 10, 0) == 50 * more
    monkeypatch.setattr(auto, "FEW_PASSES", 0)
    assert growth_budget.most_after(setup, setup.schedule, 10, 0) == 50


@pytest.mark.parametrize("longer", [700, 3_000, 5_000])
def test_a_changed_length_still_reaches_the_budget(longer):
    """The remaining growth is divided among the remaining edits."""
    counting = Counting("views", ViewsPerStepSpec((1,)), 50, min_refinements=6)
    first = Schedule.for_run(2_000, counting=counting)
    turn = first.step_of(first.next_edit(first.densify_from + first.densify_every))
    wanted = Schedule.for_run(longer, counting=counting)
    schedule, present, reached = first, 1_000, []
    config = RunConfig(growth="budget", max_gaussians=9_000)
    numbers = SimpleNamespace(growth="budget", max_gaussians=9_000)
    state = SimpleNamespace(states={}, step=0, primitives=lambda _: present)
    for step in range(1, max(longer, 2_000) + 1):
        if step == turn + 1:
            schedule = first.with_length(wanted, turn)
        state.step = step
        if step <= schedule.total and schedule.densifies(step):
            setup = SimpleNamespace(config=config, schedule=schedule, numbers=numbers)
            present = max(present, growth_budget._most(setup, state))
            reached.append(present)
    assert len(reached) >= 3
    assert reached == sorted(reached) and reached[-1] == 9_000
    assert reached[0] < 3_000


def test_a_resumed_run_knows_its_initial_number_of_primitives(tmp_path):
    setup = setup_of("adc", max_gaussians=75, growth="budget")
    whole = counts_of(setup)
    state = first_state(setup)
    for _ in range(3):
        timed_step(setup, state)
    save(tmp_path, to_checkpoint(state), Keep(every=None))
    state = from_checkpoint(setup, load(latest(tmp_path)))
    assert [timed_step(setup, state).primitives for _ in range(6)] == whole[4:]


def test_a_run_without_a_budget_stores_no_budget_state():
    state = first_state(setup := setup_of("adc", max_gaussians=60))
    for _ in range(3):
        timed_step(setup, state)
    assert growth_budget.STATE not in state.states


@pytest.mark.parametrize(
    ("text", "value"), [("auto", "auto"), ("5000", 5000), ("0", 0), (None, None)]
)
def test_budgets_are_read_as_written(text, value):
    assert RunConfig(max_gaussians=text).max_gaussians == value


@pytest.mark.parametrize("text", ["-3", "many", "1.5"])
def test_invalid_budgets_are_refused(text):
    with pytest.raises(ValidationError):
        RunConfig(max_gaussians=text)


def test_no_growth_is_allowed_after_the_end_of_density_control():
    setup = setup_of("adc")
    schedule = replace(setup.schedule, densify_until=2)
    state = SimpleNamespace(step=5)
    assert growth_budget.max_new_gaussians(SimpleNamespace(schedule=schedule), state, None) == 0

"""Schedules: published numbers at 30,000 steps, floors below, absolute on request."""

from dataclasses import replace

import numpy as np
import pytest

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.blocks import LearningRate
from crossgrad_core.contract.schedule import (
    SHORTEST_INTERVAL,
    SHORTEST_WARM_UP,
    Counting,
    Schedule,
    ViewsPerStepSpec,
)
from crossgrad_core.registry.entries import build
from crossgrad_core.run.assemble import assemble
from crossgrad_core.run.decisions import with_decisions
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.training.schedules import schedule_of
from crossgrad_core.training.setup import learns_in


def test_the_published_schedule_holds_at_the_reference_length():
    absolute = Schedule.for_run(30_000, "absolute")
    assert Schedule.for_run(30_000) == replace(absolute, mode="scaled")


def test_short_runs_have_a_scaled_schedule_with_minimum_values_and_no_reset():
    schedule = Schedule.for_run(2000)
    assert (schedule.densify_from, schedule.densify_until) == (500, 1000)
    assert schedule.densify_every == 100
    assert schedule.sh_interval == 100
    assert schedule.reset_every is None
    assert not any(schedule.resets(step) for step in range(1, 2001))


def test_the_published_schedule_has_the_known_densification_steps():
    schedule = Schedule.for_run(30_000)
    steps = [step for step in range(1, 30_001) if schedule.densifies(step)]
    assert (steps[0], steps[-1], len(steps)) == (600, 14_900, 144)
    assert [s for s in range(1, 30_001) if schedule.resets(s)] == [3000, 6000, 9000, 12_000]


@pytest.mark.parametrize(("step", "degree"), [(1, 0), (999, 0), (1000, 1), (3000, 3), (30_000, 3)])
def test_sh_degree_grows_by_one_per_interval(step, degree):
    assert Schedule.for_run(30_000).sh_degree(step) == degree


@pytest.mark.parametrize("every", range(1, 20))
def test_sparse_updates_happen_once_in_every_n_steps_and_reach_all_views_of_a_cycle(every):
    learns = np.array([learns_in(step, every) for step in range(1, 100 * every + 1)])
    assert (learns.reshape(100, every).sum(axis=1) == 1).all()
    for turns in (2, 3, 4, 8):
        counts = np.bincount(np.flatnonzero(learns) % turns, minlength=turns)
        assert counts.min() >= 0.4 * counts.mean()


@pytest.mark.parametrize("mode", ["scaled", "absolute"])
@pytest.mark.parametrize("total", [400, 600, 900, 1200, 1201, 1202, 2000, 30_000, 45_000])
def test_edits_are_counted_without_a_loop_over_the_steps(total, mode):
    schedule = Schedule.for_run(total, mode)
    edits = [step for step in range(1, total + 1) if schedule.densifies(step)]
    assert schedule.grows == bool(edits)
    assert edits[:1] == ([schedule.first_edit] if edits else [])
    for after in (0, 500, 599, 600, 650, total // 2, total):
        assert schedule.edits(after) == sum(step > after for step in edits)


def test_a_new_length_moves_future_ends_in_the_schedule_and_changes_no_interval():
    schedule = Schedule.for_run(20_000)
    longer = schedule.with_length(Schedule.for_run(40_000), 3000)
    assert (longer.total, longer.lr_until, longer.densify_until) == (40_000, 40_000, 20_000)
    for name in ("sh_interval", "densify_from", "densify_every", "reset_every", "coarse_until"):
        assert getattr(longer, name) == getattr(schedule, name)


@pytest.mark.parametrize(("step", "until"), [(700, 750), (900, 900), (1000, 1000), (1200, 1000)])
def test_density_control_that_has_ended_does_not_start_again(step, until):
    schedule = Schedule.for_run(2000).with_length(Schedule.for_run(1500), step)
    assert schedule.densify_until == until
    again = schedule.with_length(Schedule.for_run(4000), 1300)
    assert again.densify_until == until


def test_large_gaussians_are_never_pruned_without_a_reset_at_any_length():
    schedule = Schedule.for_run(9000).with_length(Schedule.for_run(12_000), 100)
    assert schedule.reset_every is None
    assert not any(schedule.prunes_large(step) for step in range(12_001))


@pytest.mark.parametrize(("total", "mode"), [(20_000, "scaled"), (2500, "absolute")])
def test_large_gaussians_are_pruned_after_the_first_reset_at_any_length(total, mode):
    schedule = Schedule.for_run(total, mode).with_length(Schedule.for_run(40_000, mode), 100)
    first = next(step for step in range(1, 40_001) if schedule.resets(step))
    assert not schedule.prunes_large(first) and schedule.prunes_large(first + 1)


def test_delayed_sh_bands_reach_the_degree_of_the_plain_schedule():
    plain = Schedule.for_run(2000)
    waiting = replace(plain, sh_wait=250)
    assert [waiting.sh_degree(step) for step in (0, 100, 249, 250, 299, 300)] == [0, 0, 0, 2, 2, 3]
    assert replace(waiting, sh_from=1).sh_degree(249) == 1
    assert all(waiting.sh_degree(step) == plain.sh_degree(step) for step in range(250, 2001))


@pytest.mark.parametrize(
    ("step", "wait"), [(100, 900), (899, 900), (950, 950), (999, 999), (1000, 1000), (1500, 1000)]
)
def test_active_sh_bands_stay_active_when_the_length_changes(step, wait):
    schedule = replace(Schedule.for_run(2000), sh_wait=1000)
    other = replace(Schedule.for_run(1800), sh_wait=900)
    longer = replace(Schedule.for_run(4000), sh_wait=2000)
    assert schedule.with_length(other, step).sh_wait == wait
    later = schedule.with_length(longer, step)
    assert later.sh_wait == (2000 if step < 1000 else 1000)
    assert later.sh_degree(step) == schedule.sh_degree(step)


def test_a_longer_run_does_not_lengthen_the_coarse_phase():
    schedule = Schedule.for_run(1000)
    assert schedule.with_length(Schedule.for_run(2000), 100).coarse_until == 250
    assert schedule.with_length(Schedule.for_run(800), 100).coarse_until == 200


def test_learning_rate_is_log_linear_and_clipped():
    rate = LearningRate(1e-2, 1e-4)
    assert rate.at(0.0) == pytest.approx(1e-2)
    assert rate.at(0.5) == pytest.approx(1e-3)
    assert rate.at(7.0) == pytest.approx(1e-4)
    assert LearningRate(0.0).at(0.3) == 0.0


FEWEST_EDITS = 6


def in_views(text="1", photos=24, schedule_length=None):
    return Counting("views", ViewsPerStepSpec.parsed(text), photos, schedule_length, FEWEST_EDITS)


def view_counts(schedule, happens=Schedule.densifies):
    """How many views are drawn by the end of each step after which something happens."""
    steps = range(1, schedule.total + 1)
    return [schedule.pace.views(step) for step in steps if happens(schedule, step)]


def test_the_published_schedule_is_the_same_in_views_and_in_steps():
    steps, views = (Schedule.for_run(30_000, counting=each) for each in (Counting(), in_views()))
    assert view_counts(views) == view_counts(steps) and len(view_counts(views)) == 144
    resets = view_counts(views, Schedule.resets)
    assert resets == view_counts(steps, Schedule.resets) == [3000, 6000, 9000, 12_000]
    for step in (1, 999, 1000, 3000, 3001, 14_999, 15_000, 30_000):
        for method in (Schedule.sh_degree, Schedule.collects, Schedule.prunes_large):
            assert method(views, step) == method(steps, step)
        assert views.progress(step) == steps.progress(step)


@pytest.mark.sampled(7)
@pytest.mark.parametrize("views", [600, 2400, 12_000])
@pytest.mark.parametrize("densifier", ["adc", "mcmc", "multiview", "revising", "anchor", "octree"])
def test_runs_with_one_and_two_views_per_step_have_events_after_the_same_views(views, densifier):
    window = build("densifiers", densifier, {}).window
    one = window(Schedule.for_run(views, counting=in_views("1")))
    two = window(Schedule.for_run(views // 2, counting=in_views("2")))
    for name in ("densifies", "resets", "prunes_large"):
        happens = getattr(Schedule, name)
        counts = view_counts(one, happens), view_counts(two, happens)
        if name == "prunes_large":  # From the step after the first reset on.
            counts = tuple(each[:1] for each in counts)
        # A step of two views reaches an odd count one view later.
        assert [count + count % 2 for count in counts[0]][: len(counts[1])] == counts[1]
        assert len(counts[0]) == len(counts[1])
    for step in range(0, views // 2, 7):
        assert two.sh_degree(step) == one.sh_degree(2 * step)
        assert two.progress(step) == one.progress(2 * step)
    assert two.coarse_until == one.coarse_until and two.lr_until == one.lr_until


@pytest.mark.sampled(29)
@pytest.mark.parametrize("text", ["1", "2", "3", "1..2@0.5", "4..1@0.2"])
@pytest.mark.parametrize("steps", [100, 601, 1200, 2500])
@pytest.mark.parametrize("photos", [1, 24, 112, 3000])
def test_long_enough_runs_have_at_least_six_edits_one_pass_apart(text, steps, photos):
    schedule = Schedule.for_run(steps, counting=in_views(text, photos))
    counts = view_counts(schedule)
    assert len(counts) == schedule.edits() >= FEWEST_EDITS
    last = schedule.pace.views(steps) // 2
    assert counts[-1] - max(schedule.pace.counts) < last == schedule.densify_until
    if FEWEST_EDITS * photos < last:
        assert schedule.densify_every >= photos and schedule.densify_from >= 0
    long = SHORTEST_WARM_UP + FEWEST_EDITS * max(SHORTEST_INTERVAL, photos) < last
    if long:
        assert schedule.densify_from >= SHORTEST_WARM_UP
        assert schedule.densify_every >= SHORTEST_INTERVAL


@pytest.mark.parametrize("photos", [250, 3000])
def test_the_warm_up_is_unchanged_if_there_are_more_photos_than_views_between_edits(photos):
    schedule = Schedule.for_run(1250, counting=in_views("2", photos))
    assert schedule.densify_from == SHORTEST_WARM_UP
    assert schedule.edits() == FEWEST_EDITS


def test_the_minimum_number_of_edits_with_a_budget_follows_the_new_length():
    setup = assemble(RunConfig(steps=700, views=1), sample_scene(), "none")

    def schedule(views):
        config = setup.at_length(views, None).in_force
        return schedule_of(config, setup.densifier, views, setup.schedule.counting)

    short, long = schedule(599), schedule(600)
    assert short.edits() == 0
    assert long.edits() == FEWEST_EDITS
    assert short.with_length(long, 100).edits() == FEWEST_EDITS
    assert long.with_length(short, 100).min_refinements == 0


def test_without_min_refinements_the_minimum_values_of_a_schedule_count_views():
    def default(steps, photos=24):
        return Schedule.for_run(
            steps, counting=Counting("views", ViewsPerStepSpec.parsed("2"), photos)
        )

    assert not default(500).grows
    assert view_counts(default(900)) == [600, 700, 800]
    assert default(900).with_length(default(700), 100).min_refinements == 0
    assert default(15_000, photos=300).densify_every == 300
    assert default(900, photos=300).densify_every == 100  # A pass would leave one edit.


@pytest.mark.parametrize(
    ("total", "k", "edits"),
    [(1, 2, 0), (17, 1, 0), (18, 1, 1), (10, 2, 1), (97, 1, 5), (98, 1, 6), (49, 2, 6)],
)
def test_a_run_of_a_few_steps_has_as_many_edits_as_its_steps_allow(total, k, edits):
    assert Schedule.for_run(total, counting=in_views(str(k))).edits() == edits


@pytest.mark.parametrize("text", ["1", "2", "5", "1..2@0.5", "3..1@0.4"])
@pytest.mark.parametrize("total", [30, 61, 400, 1201])
def test_edits_in_views_are_counted_without_a_loop_over_the_steps(text, total):
    schedule = Schedule.for_run(total, counting=in_views(text))
    edits = [step for step in range(1, total + 1) if schedule.densifies(step)]
    assert edits[:1] == [schedule.first_edit]
    assert all(schedule.collects(step) for step in range(1, edits[-1] + 1))
    for after in (0, 1, edits[0] - 1, edits[0], edits[-1] - 1, edits[-1], total):
        assert schedule.edits(after) == sum(step > after for step in edits)


def test_a_flat_schedule_of_a_longer_run_equals_the_schedule_at_its_reference_length():
    short = Schedule.for_run(1200, counting=in_views())
    flat = Schedule.for_run(2400, "absolute", in_views(schedule_length=1200))
    stretched = Schedule.for_run(2400, counting=in_views())
    assert view_counts(flat) == view_counts(short) != view_counts(stretched)
    for step in (1, 300, 1200):
        assert flat.progress(step) == short.progress(step)
        assert flat.sh_degree(step) == short.sh_degree(step)
    assert flat.progress(2400) == 2.0 and flat.coarse_until == short.coarse_until
    assert LearningRate(1e-2, 1e-4).at(flat.progress(1800)) == pytest.approx(1e-4)


@pytest.mark.parametrize("text", ["1", "2", "5..1@0.5"])
@pytest.mark.parametrize("views", [250, 600, 605, 2400])
def test_edits_of_a_flat_schedule_after_the_end_of_the_run_do_not_count(text, views):
    total = ViewsPerStepSpec.parsed(text).steps_of(views)
    schedule = Schedule.for_run(total, "absolute", in_views(text, schedule_length=1200))
    edits = [step for step in range(1, total + 1) if schedule.densifies(step)]
    for after in (0, total // 2, total):
        assert schedule.edits(after) == sum(step > after for step in edits)


def test_a_flat_schedule_in_steps_has_the_minimum_values_of_a_short_run():
    flat = Schedule.for_run(4000, "absolute", Counting(schedule_length=2000))
    short = Schedule.for_run(2000)
    assert view_counts(flat) == view_counts(short) == [600, 700, 800, 900]


def test_an_absolute_schedule_without_a_reference_length_has_the_published_numbers():
    steps = Schedule.for_run(20_000, "absolute")
    views = Schedule.for_run(20_000, "absolute", in_views(photos=3000))
    assert view_counts(views) == view_counts(steps) == list(range(600, 15_000, 100))


@pytest.mark.parametrize("text", ["1", "2", "1..2@0.5"])
@pytest.mark.parametrize(("planned", "actual"), [(3000, 900), (900, 3000), (3000, 400), (300, 480)])
@pytest.mark.parametrize("after", [1, 20, 200])
def test_a_run_whose_length_follows_the_clock_keeps_the_minimum_number_of_edits(
    text, planned, actual, after
):
    counting = in_views(text, photos=24)
    schedule = Schedule.for_run(planned, counting=counting)
    done = [step for step in range(1, after + 1) if schedule.densifies(step)]
    lengths = [planned + (actual - planned) * k // 5 for k in range(1, 6)]
    for k, length in enumerate(lengths):
        step = after + k * after // 10
        schedule = schedule.with_length(Schedule.for_run(length, counting=counting), step)
        reached = after + (k + 1) * after // 10
        done += [s for s in range(step + 1, reached + 1) if schedule.densifies(s)]
    step = after + 5 * after // 10
    edits = [s for s in range(step + 1, actual + 1) if schedule.densifies(s)]
    assert schedule.edits(step) == len(edits)
    if step < actual // 2:
        assert schedule.edits_before + schedule.edits() >= FEWEST_EDITS
        assert len(done) + len(edits) >= FEWEST_EDITS


@pytest.mark.sampled(7)
@pytest.mark.parametrize("text", ["1", "2", "1..2@0.5"])
@pytest.mark.parametrize("seed", range(20))
def test_repeated_changes_of_length_keep_past_events_and_reschedule_later_ones(text, seed):
    rng, counting = np.random.default_rng(seed), in_views(text, photos=9)
    schedule, step = Schedule.for_run(int(rng.integers(1, 1000)), counting=counting), 0
    while step + 1 < schedule.total:
        step = int(rng.integers(step + 1, schedule.total))
        length = step + int(rng.integers(1, 1500))
        later = schedule.with_length(Schedule.for_run(length, counting=counting), step)
        assert later.total == length and later.pace.views(step) == schedule.pace.views(step)
        edits = schedule.edits_before + schedule.edits() - schedule.edits(step)
        assert later.edits_before == edits or later.counted(step) >= later.densify_until
        assert later.grows or not edits
        assert later.edits(step) == sum(map(later.densifies, range(step + 1, length + 1)))
        if schedule.counted(step) >= schedule.densify_until:
            assert later.edits(step) == 0 and not later.collects(step + 1)
        schedule = later if length < 5000 else schedule
        if rng.random() < 0.1:
            return


def test_densification_times_set_by_the_user_do_not_change_with_the_length():
    counting = in_views("2")
    config = RunConfig(steps=600, densify_from=30, densify_every=40, densify_until=400)
    config, *_ = with_decisions(config, sample_scene())
    densifier = build("densifiers", "adc", {})
    schedule = schedule_of(config, densifier, 600, counting)
    assert view_counts(schedule) == list(range(70, 400, 40))
    other = schedule.with_length(schedule_of(config, densifier, 900, counting), 100)
    assert view_counts(other) == view_counts(schedule)


@pytest.mark.parametrize(
    ("settings", "unit"),
    [
        ({}, "views"),
        ({"schedule": "absolute"}, "steps"),
        ({"schedule": "absolute", "schedule_length": 600}, "views"),
        ({"recipe": {"name": "published"}}, "steps"),
        ({"schedule_unit": "steps"}, "steps"),
        ({"recipe": {"name": "published"}, "schedule_unit": "views"}, "views"),
    ],
)
def test_the_published_recipe_counts_steps_and_other_recipes_count_views(settings, unit):
    config, *_ = with_decisions(RunConfig(**settings), sample_scene())
    assert config.schedule_unit == unit

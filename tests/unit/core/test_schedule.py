"""Schedules: published numbers at 30,000 steps, floors below, absolute on request."""

from dataclasses import replace

import pytest

from crossgrad_core.contract.blocks import LearningRate
from crossgrad_core.contract.schedule import Schedule


def test_published_schedule_at_reference_length():
    absolute = Schedule.for_run(30_000, "absolute")
    assert Schedule.for_run(30_000) == replace(absolute, mode="scaled")


def test_short_runs_are_scaled_with_floors_and_have_no_reset():
    schedule = Schedule.for_run(2000)
    assert (schedule.densify_from, schedule.densify_until) == (500, 1000)
    assert schedule.densify_every == 100
    assert schedule.sh_interval == 100
    assert schedule.reset_every is None
    assert not any(schedule.resets(step) for step in range(1, 2001))


def test_densification_steps_of_the_published_schedule():
    schedule = Schedule.for_run(30_000)
    steps = [step for step in range(1, 30_001) if schedule.densifies(step)]
    assert (steps[0], steps[-1], len(steps)) == (600, 14_900, 144)
    assert [s for s in range(1, 30_001) if schedule.resets(s)] == [3000, 6000, 9000, 12_000]


@pytest.mark.parametrize(("step", "degree"), [(1, 0), (999, 0), (1000, 1), (3000, 3), (30_000, 3)])
def test_sh_degree_grows_by_one_per_interval(step, degree):
    assert Schedule.for_run(30_000).sh_degree(step) == degree


@pytest.mark.parametrize("total", [900, 1200, 1201, 1202, 2000, 30_000, 45_000])
def test_edits_are_counted_without_looking_at_every_step(total):
    schedule = Schedule.for_run(total)
    edits = [step for step in range(1, total) if schedule.densifies(step)]
    assert schedule.grows == bool(edits)
    assert edits[:1] in ([], [schedule.first_edit])
    for after in (0, 500, 599, 600, 650, total // 2, total):
        assert schedule.edits(after) == sum(step > after for step in edits)


def test_a_new_length_moves_the_ends_that_are_ahead_and_no_interval():
    schedule = Schedule.for_run(20_000)
    longer = schedule.lengthened(Schedule.for_run(40_000), 3000)
    assert (longer.total, longer.lr_steps, longer.densify_until) == (40_000, 40_000, 20_000)
    for name in ("sh_interval", "densify_from", "densify_every", "reset_every", "coarse_until"):
        assert getattr(longer, name) == getattr(schedule, name)


@pytest.mark.parametrize(("step", "until"), [(700, 750), (900, 900), (1000, 1000), (1200, 1000)])
def test_density_control_ends_where_it_may_and_never_comes_back(step, until):
    schedule = Schedule.for_run(2000).lengthened(Schedule.for_run(1500), step)
    assert schedule.densify_until == until
    again = schedule.lengthened(Schedule.for_run(4000), 1300)
    assert again.densify_until == until


def test_large_gaussians_are_never_pruned_without_a_reset_whatever_the_length():
    schedule = Schedule.for_run(9000).lengthened(Schedule.for_run(12_000), 100)
    assert schedule.reset_every is None
    assert not any(schedule.prunes_large(step) for step in range(12_001))


@pytest.mark.parametrize(("total", "mode"), [(20_000, "scaled"), (2500, "absolute")])
def test_large_gaussians_are_pruned_after_the_first_reset_whatever_the_length(total, mode):
    schedule = Schedule.for_run(total, mode).lengthened(Schedule.for_run(40_000, mode), 100)
    first = next(step for step in range(1, 40_001) if schedule.resets(step))
    assert not schedule.prunes_large(first) and schedule.prunes_large(first + 1)


def test_the_coarse_phase_never_gets_longer():
    schedule = Schedule.for_run(1000)
    assert schedule.lengthened(Schedule.for_run(2000), 100).coarse_until == 250
    assert schedule.lengthened(Schedule.for_run(800), 100).coarse_until == 200


def test_learning_rate_is_log_linear_and_clipped():
    rate = LearningRate(1e-2, 1e-4)
    assert rate.at(0.0) == pytest.approx(1e-2)
    assert rate.at(0.5) == pytest.approx(1e-3)
    assert rate.at(7.0) == pytest.approx(1e-4)
    assert LearningRate(0.0).at(0.3) == 0.0

"""Schedules: published numbers at 30,000 steps, floors below, absolute on request."""

import pytest

from crossgrad_core.blocks import LearningRate
from crossgrad_core.schedule import Schedule


def test_published_schedule_at_reference_length():
    assert Schedule.for_run(30_000) == Schedule.for_run(30_000, "absolute")


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


def test_learning_rate_is_log_linear_and_clipped():
    rate = LearningRate(1e-2, 1e-4)
    assert rate.at(0.0) == pytest.approx(1e-2)
    assert rate.at(0.5) == pytest.approx(1e-3)
    assert rate.at(7.0) == pytest.approx(1e-4)
    assert LearningRate(0.0).at(0.3) == 0.0

"""K over a run: plans in text, how views add up, and lengths in views."""

from dataclasses import replace

import pytest

from crossgrad_core.contract.schedule import ViewsPerStep, ViewsPerStepSpec

PLANS = ["1", "2", "7", "1..2@0.5", "2..1@0.3", "1..2@0.25..4@0.75", "4..3@0.01..12@0.99"]


def ks(plan, total):
    """K of every step, one by one."""
    edges = [round(share * total) for share in plan.shares]
    return [plan.counts[sum(step > edge for edge in edges)] for step in range(1, total + 1)]


@pytest.mark.parametrize("text", PLANS)
def test_a_views_per_step_spec_prints_as_its_text(text):
    plan = ViewsPerStepSpec.parsed(text)
    assert str(plan) == text
    assert plan.setting == (text if ".." in text else int(text))


@pytest.mark.parametrize("text", PLANS)
@pytest.mark.parametrize("total", [1, 2, 3, 10, 57])
def test_views_add_up_step_by_step(text, total):
    plan = ViewsPerStepSpec.parsed(text)
    pace, wanted = plan.paced(total), ks(plan, total)
    assert [pace.at(step) for step in range(1, total + 1)] == wanted
    sums = [sum(wanted[:step]) for step in range(total + 1)]
    assert [pace.views(step) for step in range(total + 1)] == sums
    for views in range(sums[-1] + 1):
        assert pace.step_of(views) == next(s for s in range(total + 1) if sums[s] >= views)


@pytest.mark.sampled(53)
@pytest.mark.parametrize("text", PLANS)
@pytest.mark.parametrize("views", [*range(30), 1000, 2401])
def test_a_length_in_views_becomes_the_largest_number_of_steps_within_it(text, views):
    plan = ViewsPerStepSpec.parsed(text)
    steps = plan.steps_of(views)
    assert plan.paced(steps).views(steps) <= views
    assert plan.paced(steps + 1).views(steps + 1) > views


def test_k_changes_at_half_of_the_steps():
    pace = ViewsPerStepSpec.parsed("1..2@0.5").paced(10)
    assert [pace.at(step) for step in range(1, 11)] == [1] * 5 + [2] * 5
    assert pace.views(10) == 15 and ViewsPerStepSpec.parsed("1..2@0.5").steps_of(15) == 10


@pytest.mark.parametrize(
    "text",
    [
        *("", "0", "-1", "two", "1.5", "1..2", "1..2@", "1..2@0", "1..2@1", "1..2@1.5", "1..2@x"),
        *("1..1@0.5", "0..2@0.5", "1..2@0.5..3@0.5", "1..2@0.5..3@0.4", "1@0.5", "1..2@nan"),
    ],
)
def test_an_invalid_views_per_step_spec_is_refused(text):
    with pytest.raises(ValueError, match="must "):
        ViewsPerStepSpec.parsed(text)


@pytest.mark.parametrize(("step", "start"), [(10, 40), (19, 40), (20, 40), (21, 20), (30, 20)])
def test_a_future_change_of_k_moves_with_the_length(step, start):
    plan = ViewsPerStepSpec.parsed("1..2@0.5")
    assert plan.paced(40).moved(plan.paced(80), step) == ViewsPerStep((0, start), (1, 2))


def test_a_change_of_k_that_would_be_in_the_past_applies_from_the_current_step():
    plan = ViewsPerStepSpec.parsed("1..2@0.5..3@0.9")
    pace = plan.paced(100)
    moved = pace.moved(plan.paced(50), 40)
    assert moved == replace(pace, starts=(0, 40, 45))
    assert moved.views(40) == pace.views(40)

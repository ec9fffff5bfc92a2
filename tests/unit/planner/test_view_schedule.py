"""When the planner lets far views come more often: drone and street, not two flight levels."""

import json
from dataclasses import replace

import numpy as np
import pytest

from crossgrad_core.commands import ComponentChoice, UserError, configured
from crossgrad_core.run import decisions
from crossgrad_core.run.assemble import assemble
from crossgrad_core.testing.fixtures import posed_scene, posed_view
from crossgrad_plugins.planner.evidence import Evidence
from crossgrad_plugins.planner.planner import plan_of
from crossgrad_plugins.planner.view_schedule import directions, view_schedule

RNG = np.random.default_rng(0)
CLOUD = np.column_stack([RNG.uniform(0, 60, 400), RNG.uniform(0, 60, 400), RNG.uniform(0, 6, 400)])
EVERY = range(len(CLOUD))
#: How near photos look: along the street, and down from a lower flight level.
AROUND = [(0.3, 1, 0), (0, 1, 0), (-0.3, 1, 0), (0, 1, 0.1)]
DOWN = [(0.1, 0, -1), (0, 0.1, -1)]


def scene_of(low, height=2.0):
    """Twelve photos from 90 m down, twelve from `height` in the directions of `low`."""
    far = [
        posed_view(
            (20 * (i % 4), 20 * (i // 4), 90.0), f"far{i}.png", forward=(0, 0.2, -1), seen=EVERY
        )
        for i in range(12)
    ]
    near = [
        posed_view(
            (20 * (i % 4), -20 - 2 * (i // 4), height),
            f"near{i}.png",
            forward=low[i % len(low)],
            seen=EVERY,
        )
        for i in range(12)
    ]
    return posed_scene([*far, *near], CLOUD)


def decision(scene, **given):
    return view_schedule(Evidence(configured({"scene": "x", "steps": 100, **given}), scene))


def test_the_far_first_schedule_is_chosen_if_only_near_views_look_in_many_directions():
    scene = scene_of(AROUND)
    found = decision(scene)
    assert found.basis == "decided"
    assert found.settings["sampler"] == "horizon"
    assert found.settings["sampler.coarse"] == [5, 1]
    assert found.figures["far_degrees"] < 5 and found.figures["near_degrees"] > 70
    assert found.force == "--sampler epoch"
    json.dumps(found.as_data())


def test_the_decided_view_schedule_becomes_the_sampler_of_the_run():
    scene = scene_of(AROUND)
    plan = plan_of(configured({"scene": "x", "steps": 100}), scene)
    run = assemble(configured(plan.applied_to({"scene": "x", "steps": 100})), scene, "colmap")
    assert (run.sampler.coarse, run.sampler.fine) == ((5, 1), (1, 1))
    assert run.sampler.default_views == 1


@pytest.mark.parametrize(
    "length", [{"steps": 100}, {"seconds": 5.0}, {"max_views": 100}, {"steps": 29_999}], ids=str
)
def test_a_short_run_uses_the_far_first_schedule(length):
    run = assemble(configured({"scene": "x", **length}), scene_of(AROUND), "colmap")
    assert run.selection.names["sampler"] == "horizon"
    assert run.selection.names["grouping"] == run.config.grouping.name
    assert run.sampler.coarse == (5, 1)
    row = next(row for row in run.decisions if row.setting == "sampler")
    assert (row.value, row.override) == ("horizon", "--sampler epoch")
    assert run.config.decided["sampler"] == row.because


@pytest.mark.parametrize("given", [{"steps": 100}, {"seconds": 5.0}, {"steps": 30_000}], ids=str)
def test_runs_without_a_plan_use_the_epoch_sampler(given):
    asked = configured({"scene": "x", "plan": "off", **given})
    run = assemble(asked, scene_of(AROUND), "colmap")
    assert run.selection.names["sampler"] == "epoch"
    assert "sampler" not in run.config.decided


@pytest.mark.parametrize(
    "given",
    [{"steps": 100, "sampler": {"name": "epoch"}}, {"steps": 100, "schedule": "absolute"}],
    ids=str,
)
def test_settings_of_the_user_that_exclude_the_plan_keep_the_epoch_sampler(given):
    asked = configured({"scene": "x", **given})
    run = assemble(asked, scene_of(AROUND), "colmap")
    assert run.selection.names["sampler"] == "epoch"


def broken(*_arguments):
    raise RuntimeError("worn out")


def missing(*_arguments):
    raise UserError("there is no planner called scene")


@pytest.mark.parametrize(
    ("name", "value"), [("resolve_entry", lambda _: broken), ("find", missing)]
)
def test_the_planner_is_called_only_if_a_plan_is_requested(name, value, monkeypatch):
    monkeypatch.setattr(decisions, name, value)
    off = configured({"scene": "x", "steps": 100, "plan": "off"})
    assemble(off, scene_of(AROUND), "colmap")
    asked = configured({"scene": "x", "steps": 100})
    with pytest.raises((RuntimeError, UserError)):
        assemble(asked, scene_of(AROUND), "colmap")


def test_long_runs_use_the_epoch_sampler():
    found = decision(scene_of(AROUND), steps=30_000)
    assert (found.choice, found.settings) == ("epoch", {})
    assert found.evidence == "measured only in shorter runs"


@pytest.mark.parametrize(("photos", "short"), [(100, True), (400, False)])
def test_a_planned_run_with_many_photos_does_not_count_as_short(photos, short):
    views = scene_of(AROUND).views
    scene = posed_scene([replace(views[i % 24], name=f"{i}.png") for i in range(photos)], CLOUD)
    found = view_schedule(Evidence(configured({"scene": "x"}), scene))
    assert bool(found.settings) == short


@pytest.mark.parametrize("height", [20.0, 30.0])
def test_a_scene_of_two_flight_levels_uses_the_epoch_sampler(height):
    found = decision(scene_of(DOWN, height))
    assert not found.settings
    assert found.choice == "epoch"
    assert "degrees away" in found.evidence


def test_a_scene_with_one_distance_mode_uses_the_epoch_sampler():
    views = [posed_view((3 * i, 0, 90.0), f"{i}.png", forward=(0, 0.2, -1)) for i in range(24)]
    found = decision(posed_scene(views, CLOUD))
    assert (found.choice, dict(found.settings)) == ("epoch", {})


@pytest.mark.parametrize("given", [{"sampler": "random"}, {"grouping": "radial"}])
def test_settings_of_the_user_override_the_decision(given):
    given = {name: {"name": value} for name, value in given.items()}
    assert decision(scene_of(AROUND), **given).basis == "given"


@pytest.mark.parametrize(
    "given",
    [{"operator": {"name": "pcgrad"}}, {"views_per_step": 2}, {"recipe": {"name": "published"}}],
)
def test_the_far_first_schedule_is_not_chosen_for_settings_without_measurements(given):
    found = decision(scene_of(AROUND), **given)
    assert (found.basis, dict(found.settings)) == ("default", {})


def test_a_small_far_mode_does_not_get_the_far_first_schedule():
    views = scene_of(AROUND).views
    found = decision(posed_scene([*views[:6], *views[12:]], CLOUD))
    assert not found.settings
    assert found.evidence == "the smaller mode has 33% of the views"


def test_far_views_in_many_directions_do_not_differ_from_near_views_in_direction():
    low = scene_of(AROUND).views[12:]
    ring = [(np.cos(angle), np.sin(angle), 0) for angle in np.linspace(0, 2 * np.pi, 12, False)]
    high = [posed_view((0, 0, 90.0), f"{i}.png", forward=f) for i, f in enumerate(ring)]
    found = directions(posed_scene([*high, *low], CLOUD), ComponentChoice(name="altitude"))
    assert found.far > 45.0
    assert not found.differ

"""Numbers of views, missing groups, tiny scenes, identical cameras."""

from types import SimpleNamespace

import numpy as np
import pytest
from support.selections import selection_of

from crossgrad_core.contract.objections import objections_to
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import build, entries
from crossgrad_core.testing.fixtures import SamplerRun, posed_scene, posed_view
from crossgrad_plugins.samplers.balanced import NearFar
from crossgrad_plugins.samplers.fps import FarthestPoint, farthest_point_order
from crossgrad_plugins.samplers.horizon import Horizon

ADMITTED = {
    "active": {2},
    "anchors-30": {2},
    "epoch": {1, 2, 3, 4, 5, 6},
    "fps": {1, 2, 3, 4, 5, 6},
    "horizon": {1, 2, 3, 4, 5, 6},
    "near-far": {2, 4, 6},
    "random": {1, 2, 3, 4, 5, 6},
    "random-split": {2, 4, 6},
    "three-way": {3},
}
NEEDS_GROUPS = ("active", "anchors-30", "horizon", "near-far", "three-way")
ONE_VIEW = ("epoch", "fps", "random")


def scene(cameras):
    return posed_scene([posed_view((i, 0, 0), f"{i}.png") for i in range(cameras)])


def objections(sampler, name, views):
    selection = selection_of(sampler=sampler, names={"sampler": name}, views_per_step=views)
    return [reason for reason in objections_to(selection) if f"sampler {name}" in reason]


@pytest.mark.parametrize("name", ADMITTED)
def test_unsupported_numbers_of_views_are_refused_with_the_reason(name):
    sampler = build("samplers", name, {})
    for views in range(1, 7):
        refused = objections(sampler, name, views)
        assert (not refused) == (views in ADMITTED[name])
        assert all(f"K is {views}" in reason and name in reason for reason in refused)


@pytest.mark.parametrize("name", ADMITTED)
def test_the_default_number_of_views_is_accepted(name):
    sampler = build("samplers", name, {})
    assert sampler.view_counts.admits(sampler.resolved_views)


def test_the_alternating_sampler_accepts_one_view_only():
    sampler = NearFar(alternating=True)
    assert sampler.resolved_views == 1
    assert not objections(sampler, "near-far", 1)
    assert objections(sampler, "near-far", 2)


def test_the_alternating_sampler_starts_with_a_near_view():
    run = SamplerRun(NearFar(alternating=True), scene(4), ("near", "near", "far", "far"))
    assert [draw.labels for draw in run.draws(3)] == [("near",), ("far",), ("near",)]


def test_a_pair_starts_with_the_near_view_and_further_pairs_follow():
    run = SamplerRun(NearFar(), scene(4), ("far", "near", "far", "near"), 4)
    assert run.draw().labels == ("near", "far", "near", "far")


def test_labels_other_than_near_and_far_alternate_in_alphabetical_order():
    run = SamplerRun(NearFar(), scene(4), ("street", "aerial", "street", "aerial"))
    draw = run.draw()
    assert draw.labels == ("aerial", "street")
    assert draw.views[0] % 2 == 1


@pytest.mark.parametrize("name", NEEDS_GROUPS)
@pytest.mark.parametrize("groups", [None, ("near",) * 4, ("a", "b", "c", "d")])
def test_missing_groups_are_a_user_error(name, groups):
    sampler = build("samplers", name, {})
    with pytest.raises(UserError, match="--grouping"):
        SamplerRun(sampler, scene(4), groups).draw()


@pytest.mark.parametrize("name", ["epoch", "fps"])
def test_more_different_views_than_training_views_are_a_user_error(name):
    with pytest.raises(UserError, match="3 different views, but only 2"):
        SamplerRun(build("samplers", name, {}), scene(2), views_per_step=3).draw()


@pytest.mark.parametrize("order", ["distinct", "epoch"])
def test_a_group_too_small_for_different_views_is_a_user_error(order):
    run = SamplerRun(NearFar(order=order), scene(4), ("near", "far", "far", "far"), 4)
    with pytest.raises(UserError, match="2 different views, but only 1"):
        run.draw()


@pytest.mark.parametrize("name", ADMITTED)
def test_a_scene_without_training_views_is_a_user_error(name):
    sampler = build("samplers", name, {})
    with pytest.raises(UserError):
        SamplerRun(sampler, posed_scene([])).draw()


@pytest.mark.parametrize("name", ONE_VIEW)
def test_one_camera_is_sufficient_for_one_view(name):
    run = SamplerRun(build("samplers", name, {}), scene(1), views_per_step=1)
    assert [draw.views for draw in run.draws(3)] == [(0,)] * 3


def test_independent_draws_may_repeat_a_single_camera():
    run = SamplerRun(build("samplers", "random", {}), scene(1))
    assert run.draw().views == (0, 0)


def test_random_halves_need_two_cameras():
    with pytest.raises(UserError, match="at least two training views"):
        SamplerRun(build("samplers", "random-split", {}), scene(1)).draw()


def test_the_horizon_sampler_may_use_a_small_group_twice_in_a_step():
    run = SamplerRun(Horizon(), scene(3), ("near", "near", "far"), 3)
    draw = run.draw()
    assert draw.views[:2] == (2, 2)
    assert draw.labels == ("far", "far", "near")


@pytest.mark.parametrize("name", ["epoch", "random", "fps"])
def test_samples_have_labels_if_there_are_groups(name):
    run = SamplerRun(build("samplers", name, {}), scene(4), ("a", "b", "c", "d"), 2)
    for draw in run.draws(5):
        assert draw.labels == tuple("abcd"[view] for view in draw.views)
    assert SamplerRun(build("samplers", name, {}), scene(4)).draw().labels is None


def test_the_farthest_point_order_spreads_points():
    line = np.array([[0.0], [1.0], [2.0], [3.0], [8.0]])
    assert farthest_point_order(line, 0) == [0, 4, 3, 1, 2]


def test_equally_far_points_are_ordered_by_index():
    assert farthest_point_order(np.zeros((4, 2)), 2) == [2, 0, 1, 3]


def test_cameras_at_one_position_are_distinguished_by_direction():
    forwards = [(1, 0, 0), (1, 0.1, 0), (-1, 0, 0), (0, 1, 0)]
    views = [posed_view((0, 0, 0), f"{i}.png", forward=f) for i, f in enumerate(forwards)]
    run = SamplerRun(FarthestPoint(), posed_scene(views), views_per_step=4)
    opposite = {0: 2, 1: 2, 2: 0}
    for draw in run.draws(20):
        assert opposite.get(draw.views[0], draw.views[1]) == draw.views[1]


def test_these_tests_cover_every_bundled_sampler():
    ours = {n for n, e in entries("samplers").items() if "crossgrad_plugins" in e.value}
    assert ours == set(ADMITTED)


def test_an_outlier_camera_does_not_determine_the_unit_of_pose_space():
    def poses(places):
        cameras = posed_scene([posed_view((x, 0, 0), f"{x}.png") for x in places])
        return FarthestPoint()._poses(SimpleNamespace(scene=cameras, centers=cameras.centers))

    np.testing.assert_array_equal(poses(range(8)), poses([*range(8), 1e6])[:8])

"""Gains of photos from SfM tracks: planted ones are found, and the rule tells scenes apart."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from support.grey_scene import grey_scene

from crossgrad_core.plugin import Camera
from crossgrad_plugins.exposures.auto import Auto, NoExposure
from crossgrad_plugins.exposures.tracks.gains import (
    MOST_DECIDING,
    TrackGains,
    deciding_gains,
    fitted,
    track_gains,
    training_gains,
)
from crossgrad_plugins.exposures.tracks.observations import Observations, light_at, observations_of

RNG = np.random.default_rng(0)


def observed(gains, points, per_photo, noise=0.1, seed=0):
    """Observations of random points with noise and, of one in twenty, an outlier."""
    rng = np.random.default_rng(seed)
    brightness = rng.normal(-2, 1, points)
    photos = np.repeat(np.arange(len(gains)), per_photo)
    numbers = np.concatenate([np.sort(rng.choice(points, per_photo, replace=False)) for _ in gains])
    stops = gains[photos] + brightness[numbers] + rng.normal(0, noise, len(photos))
    stops += (rng.random(len(photos)) < 0.05) * rng.normal(3, 2, len(photos))
    return Observations(photos, numbers, stops, np.arange(points))


#: Photos of two groups of which few points join both, as near and far photos of one place.
NEAR, FAR = 18, 22


def two_groups(joining, offset=0.0, noise=0.2, outliers=0.05, lobes=0.0, seed=0):
    """Observations of two groups of photos that so many points join.

    Args:
        joining: Points that a photo of each group shows.
        offset: Stops by which near photos are brighter.
        noise: Standard deviation of each observation, stops.
        outliers: Share of observations that are off by far.
        lobes: Stops by which a point is brighter than its mean from the side to which it shines.
        seed: Of all random numbers.
    """
    rng = np.random.default_rng(seed)
    shown = []
    for first, last in ((0, NEAR), (NEAR, NEAR + FAR)):
        for _ in range(400):
            around = rng.integers(first, last) + rng.integers(-3, 4, 4)
            shown.append(np.unique(np.clip(around, first, last - 1)))
    for _ in range(joining):
        far = NEAR + rng.choice(FAR, rng.integers(1, 3), replace=False)
        shown.append(np.concatenate([[rng.integers(NEAR)], far]))
    photos = np.concatenate(shown)
    points = np.repeat(np.arange(len(shown)), [len(each) for each in shown])
    sides, angles = rng.uniform(0, 2 * np.pi, len(shown)), np.linspace(0, 6, NEAR + FAR)
    stops = rng.normal(-2, 1, len(shown))[points] + offset * (photos < NEAR)
    stops += rng.normal(0, noise, len(photos)) + lobes * np.cos(sides[points] - angles[photos])
    stops += (rng.random(len(photos)) < outliers) * rng.normal(1, 2, len(photos))
    return Observations(photos, points, stops, np.arange(len(shown)))


def judged(seen, photos=NEAR + FAR):
    fit = fitted(seen, photos)
    return TrackGains(fit.gains, np.bincount(seen.photos, minlength=photos), fit)


@pytest.mark.sampled(5)
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("joining", [16, 40, 200])
def test_groups_of_different_exposure_are_found_with_few_shared_points(joining, seed):
    gains = judged(two_groups(joining, offset=1.49, seed=seed))
    assert gains.gains[:NEAR].mean() - gains.gains[NEAR:].mean() == pytest.approx(1.49, abs=0.4)
    assert gains.differ


@pytest.mark.sampled(7)
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("joining", [0, 2, 4, 16, 200])
@pytest.mark.parametrize(
    "errors",
    [{}, {"noise": 0.5, "outliers": 0.15}, {"lobes": 0.4}],
    ids=["noise", "outliers", "dependence on the view"],
)
def test_photos_of_equal_exposure_do_not_differ_even_if_few_points_join_them(joining, errors, seed):
    assert not judged(two_groups(joining, **errors, seed=seed)).differ


def test_a_single_outlier_photo_does_not_decide_that_exposures_differ():
    seen = two_groups(joining=1_000, outliers=0.0)
    off = seen.stops - 1.3 * (seen.photos == NEAR)
    gains = judged(replace(seen, stops=off))
    assert gains.spread == pytest.approx(0.2, abs=0.03)
    assert gains.spread > 4 * gains.error and not gains.differ
    assert judged(replace(seen, stops=seen.stops - 1.3 * (seen.photos % 5 == 0))).differ


def test_the_error_of_gains_grows_if_few_points_join_photos():
    many, few = (judged(two_groups(joining, seed=1)).error for joining in (1_000, 10))
    assert few > 2 * many
    photos, points = np.tile([0, 1], 50), np.repeat(np.arange(50), 2)
    noise = np.random.default_rng(3).normal(0, 0.3, 100)
    # The difference of two photos has the error sqrt(2) 0.3 / sqrt(50), each from their mean half.
    assert judged(Observations(photos, points, noise, np.arange(50)), 2).error == pytest.approx(
        0.03, rel=0.3
    )


def test_known_gains_are_recovered_despite_outliers():
    planted = RNG.normal(0, 1.5, 12)
    fit = fitted(observed(planted, 60, 40), 12)
    assert np.abs(fit.gains - (planted - planted.mean())).max() < 0.08
    assert fit.reduction > 0.3


def test_a_long_chain_of_photos_is_solved_up_to_its_ends():
    # Each photo shares points with its neighbours only: what alternating fits do not cross.
    count = 200
    planted = np.linspace(-3, 3, count)
    photos = np.repeat(np.arange(count), 10)
    points = (5 * np.repeat(np.arange(count), 10) + np.tile(np.arange(10), count)).astype(np.int64)
    fit = fitted(Observations(photos, points, planted[photos], np.arange(points.max() + 1)), count)
    assert np.abs(fit.gains - planted).max() < 1e-3


@pytest.mark.parametrize(("count", "shared"), [(400, 1), (800, 5)])
def test_a_strip_of_hundreds_of_photos_is_solved_up_to_rounding(count, shared):
    planted = np.random.default_rng(1).normal(0, 1, count)
    photos = np.repeat(np.arange(count), 2 * shared)
    points = shared * photos + np.tile(np.arange(2 * shared), count)
    stops = planted[photos] + np.random.default_rng(2).normal(-2, 1, points.max() + 1)[points]
    fit = fitted(Observations(photos, points, stops, np.arange(points.max() + 1)), count)
    assert np.abs(fit.gains - (planted - planted.mean())).max() < 1e-9


@pytest.mark.parametrize("count", [20, 150])
def test_photos_that_all_share_points_are_solved_exactly(count):
    planted = np.random.default_rng(1).normal(0, 1, count)
    seen = observed(planted, 100, 60)
    exact = planted[seen.photos] + np.random.default_rng(2).normal(-2, 1, 100)[seen.points]
    fit = fitted(replace(seen, stops=exact), count)
    assert np.abs(fit.gains - (planted - planted.mean())).max() < 1e-4


def test_each_group_without_shared_points_has_a_mean_gain_of_zero():
    one = observed(np.array([1.0, 3.0]), 20, 20, noise=0.0)
    other = observed(np.array([-5.0, -5.5]), 20, 20, noise=0.0)
    joined = Observations(
        np.concatenate([one.photos, other.photos + 2]),
        np.concatenate([one.points, other.points + 20]),
        np.concatenate([one.stops, other.stops]),
        np.arange(40),
    )
    gains = fitted(joined, 4).gains
    assert gains[:2].mean() == pytest.approx(0.0, abs=0.05)
    assert gains[2:].mean() == pytest.approx(0.0, abs=0.05)
    assert gains[1] - gains[0] == pytest.approx(2.0, abs=0.05)
    assert gains[3] - gains[2] == pytest.approx(-0.5, abs=0.05)


def test_gains_without_observations_are_zero():
    none = np.zeros(0, dtype=np.int64)
    fit = fitted(Observations(none, none, np.zeros(0), none), 3)
    assert fit.gains.tolist() == [0.0] * 3
    assert fit.reduction == 0.0


def test_brightness_is_sampled_at_the_projection_of_a_point():
    camera = Camera(8, 6, 10.0, 10.0, 4.0, 3.0, torch.eye(4, dtype=torch.float64))
    points = np.array([[0.0, 0, 1], [0.2, -0.1, 1], [0, 0, -1], [9, 0, 1], [-0.39, 0, 1]])
    image = torch.zeros(6, 8, 3, dtype=torch.uint8)
    image[1:4, 5:8] = 255
    found = light_at(image, None, camera, points)
    assert found.rows.tolist() == [0, 1]  # behind, outside, and without all neighbours
    assert found.brightness.tolist() == pytest.approx([2 / 9, 1.0])
    mask = torch.ones(6, 8, dtype=torch.bool)
    mask[3, 5] = False
    assert light_at(image, mask, camera, points).rows.tolist() == []
    as_floats = light_at(image.float() / 255, None, camera, points)
    assert as_floats.brightness.tolist() == pytest.approx(found.brightness.tolist())


def test_photos_of_one_wall_differ_by_their_brightness():
    scene = grey_scene([0.1, 0.2, 0.4, 0.8])
    gains = track_gains(scene, scene.train_views)
    assert gains.gains == pytest.approx([-1.5, -0.5, 0.5, 1.5], abs=0.03)
    assert gains.counts.tolist() == [60] * 4
    assert gains.differ
    assert "4 photos at 240 observations" in gains.evidence


def test_black_white_and_unconnected_photos_have_no_gain():
    seen = [range(60)] * 4 + [range(3)]
    scene = grey_scene([0.2, 0.4, 0.0, 1.0, 0.2], seen=seen)
    gains = track_gains(scene, scene.train_views)
    assert gains.known.tolist() == [True, True, False, False, False]
    assert gains.gains[2:].tolist() == [0.0] * 3


def test_photos_differ_only_if_the_rule_finds_spread_and_reduction():
    alike = grey_scene([0.2, 0.21, 0.19, 0.2])
    assert not track_gains(alike, alike.train_views).differ
    gains = track_gains(grey_scene([0.1, 0.4]), grey_scene([0.1, 0.4]).train_views)
    assert gains.differ
    weak = replace(gains, fit=replace(gains.fit, after=0.9 * gains.fit.before))
    assert not weak.differ


def test_a_subset_of_many_photos_decides_the_gains():
    count = 5 * MOST_DECIDING // 2
    lights = np.tile([0.1, 0.1, 0.4, 0.4], count)[:count]
    # Each photo shows points of its own and those of its neighbours.
    seen = [range(8 * row, 8 * row + 16) for row in range(count)]
    scene = grey_scene(lights, points=8 * count + 8, seen=seen)
    gains = deciding_gains(scene)
    assert MOST_DECIDING // 2 <= len(gains.gains) <= MOST_DECIDING
    assert gains.differ
    assert deciding_gains(scene) is gains
    few = grey_scene([0.1, 0.4])
    assert deciding_gains(few) is training_gains(few)


def test_only_a_subset_of_many_observations_is_used(monkeypatch):
    scene = grey_scene([0.1, 0.2, 0.4])
    module = "crossgrad_plugins.exposures.tracks.observations._MOST"
    monkeypatch.setattr(module, 60)
    found = observations_of(scene, scene.train_views)
    assert found.count == 3 * 20
    gains = track_gains(scene, scene.train_views)
    assert gains.gains == pytest.approx([-1.0, 0.0, 1.0], abs=0.03)


def test_gains_of_a_scene_are_computed_once_and_released_with_the_scene():
    scene = grey_scene([0.1, 0.4])
    assert training_gains(scene) is training_gains(scene)
    import weakref

    gone = weakref.ref(scene)
    del scene
    assert gone() is None


def test_exposure_auto_selects_a_gain_by_the_rule_and_reports_the_reason():
    fitted_on = Auto().fitted_to(grey_scene([0.1, 0.2, 0.4]))
    assert fitted_on.name == "gain"
    off = Auto().fitted_to(grey_scene([0.2, 0.2, 0.2]))
    assert off.name == "none"
    assert "less than 0.2 stops, 4 standard errors or 15 %" in off.notes[0]
    blind = Auto().fitted_to(grey_scene([0.2, 0.4], seen=[(), ()]))
    assert blind.name == "none"
    assert "no SfM tracks" in blind.notes[0]


def test_exposure_none_suggests_the_gain_if_photos_differ():
    (remark,) = NoExposure().messages(grey_scene([0.1, 0.2, 0.4]), {})
    assert "--exposure gain" in remark
    assert NoExposure().messages(grey_scene([0.2, 0.2, 0.2]), {}) == ()


class Unseen:
    def image(self):
        raise AssertionError("decoded for nothing")

    mask = image


def test_photos_without_tracks_are_not_decoded():
    scene = grey_scene([0.2, 0.4], seen=[(), ()])
    scene = replace(scene, views=tuple(replace(view, photo=Unseen()) for view in scene.views))
    assert NoExposure().messages(scene, {}) == ()
    assert not training_gains(scene).known.any()


def test_a_photo_that_cannot_be_decoded_gives_no_message():
    scene = grey_scene([0.2, 0.4])
    scene = replace(scene, views=tuple(replace(view, photo=Unseen()) for view in scene.views))
    assert NoExposure().messages(scene, {}) == ()

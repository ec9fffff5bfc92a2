"""What photos near in pose tell of one, beside the mean of its regime."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from crossgrad_core.testing.fixtures import posed_scene, posed_view
from crossgrad_plugins.exposures import initial_values
from crossgrad_plugins.exposures.gain import Gain
from crossgrad_plugins.exposures.initial_values import TELLING, Neighbours

SEEDS = st.integers(0, 2**32 - 1)


def views_of(rng, count, regimes=2):
    found = []
    for number in range(count):
        look = rng.normal(size=3) + np.array([0.0, 4.0, 0.0])
        view = posed_view(rng.normal(size=3), f"{number}.png", forward=look)
        found.append(replace(view, regime=str(rng.integers(regimes))))
    return found


def told(view, others, values):
    """By the definition, with loops: the nearest few, weighted by the inverse of the distance."""
    centers = [each.camera.center.numpy() for each in others]
    return _told(view, others, values, np.median(centers, axis=0), centers)


def _told(view, others, values, middle, centers):
    scale = np.median([np.linalg.norm(center - middle) for center in centers])
    distances = []
    for each in others:
        apart = (each.camera.center - view.camera.center).numpy() / scale
        looks = (each.camera.world_to_camera[2, :3] - view.camera.world_to_camera[2, :3]).numpy()
        distances.append(np.sqrt(apart @ apart + looks @ looks))
    nearest = np.argsort(distances)[:TELLING]
    weights = 1.0 / np.maximum(np.array(distances)[nearest], 1e-3)
    return weights @ values[nearest] / weights.sum()


@given(SEEDS, st.integers(2, 12), st.integers(1, 3))
@settings(max_examples=60, deadline=None)
def test_predicted_values_agree_with_the_definition(seed, count, width):
    rng = np.random.default_rng(seed)
    views, values = views_of(rng, count), rng.normal(size=(count, width))
    asked = views_of(rng, 1)[0]
    rows, weights = Neighbours(views).rows_and_weights(asked.camera)
    assert weights.sum() == pytest.approx(1.0)
    assert weights @ values[rows] == pytest.approx(told(asked, views, values))


@given(SEEDS, st.integers(2, 12))
@settings(max_examples=60, deadline=None)
def test_leave_one_out_errors_agree_with_a_loop(seed, count):
    rng = np.random.default_rng(seed)
    views, values = views_of(rng, count), rng.normal(size=(count, 1))
    centers = [view.camera.center.numpy() for view in views]
    near, regime = [], []
    for row, view in enumerate(views):
        rest = np.delete(np.arange(count), row)
        others, their = [views[each] for each in rest], values[rest]
        # The scale is that of all photos, which leaving one out does not change.
        near.append(_told(view, others, their, np.median(centers, axis=0), centers))
        own = [each for each, other in enumerate(others) if other.regime == view.regime]
        regime.append(their[own].mean(axis=0) if own else their.mean(axis=0))
    wanted = [np.sqrt(np.square(np.array(each) - values).mean()) for each in (near, regime)]
    assert Neighbours(views).errors(values) == pytest.approx(wanted)


def test_neighbours_predict_exposure_only_if_they_predict_better_than_the_mean():
    rng = np.random.default_rng(0)
    # Of two kinds of photos that stand apart each tells of its own kind, whatever the regimes are.
    views = [
        posed_view(np.array([10.0 * (n % 2), 0, 0]) + rng.normal(size=3), f"{n}.png")
        for n in range(20)
    ]
    scene = posed_scene(views, test=(0, 1))
    kinds = torch.tensor([1.0 if n % 2 else -1.0 for n in range(2, 20)])
    for number in (0, 1):
        found = Gain().predict_unseen(views[number], scene, {"stops": kinds})
        assert float(found["stops"]) == pytest.approx(1.0 if number else -1.0)
    # What has nothing to do with places is better told by the mean.
    drawn = torch.from_numpy(rng.normal(size=18)).float()
    assert float(
        Gain().predict_unseen(views[0], scene, {"stops": drawn})["stops"]
    ) == pytest.approx(float(drawn.mean()))


def test_photos_without_evidence_start_at_the_exposure_of_their_neighbours(monkeypatch):
    rng = np.random.default_rng(0)
    kinds = np.arange(20) % 2
    views = [
        posed_view(np.array([10.0 * kind, 0, 0]) + rng.normal(size=3), f"{n:02}.png")
        for n, kind in enumerate(kinds)
    ]
    scene = posed_scene(views)
    told = {view.name: float(kind) for view, kind in zip(views[2:], kinds[2:], strict=True)}
    monkeypatch.setattr(initial_values, "exposure_values", lambda _: told)
    found = initial_values.starts_of(scene, "exif")
    assert found.stops == pytest.approx(kinds - 0.5)
    (note,) = (each for each in found.messages if "initial values of 2 photos" in each)
    assert "the photos with the nearest poses" in note and "00.png, 01.png" in note


@pytest.mark.parametrize("count", [1, 2, 3, 9])
def test_photos_with_equal_poses_give_finite_predictions(count):
    views = [posed_view((0, 0, 0), f"{n}.png") for n in range(count)]
    scene = posed_scene([*views, posed_view((0, 0, 0), "held out.png")], test=(count,))
    stops = torch.linspace(-1, 1, count)
    found = Gain().predict_unseen(scene.test_views[0], scene, {"stops": stops})["stops"]
    assert bool(torch.isfinite(found))
    assert -1.0 <= float(found) <= 1.0

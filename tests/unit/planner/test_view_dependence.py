"""View dependence of tracks: against a brute force, and on planted brightness."""

import numpy as np
import pytest

from crossgrad_core.commands import configured
from crossgrad_core.testing.fixtures import posed_scene, posed_view
from crossgrad_plugins.exposures.tracks.observations import Observations
from crossgrad_plugins.planner import appearance, view_dependence
from crossgrad_plugins.planner.evidence import Evidence

RNG = np.random.default_rng(5)
VIEWS, POINTS = 24, 160


def ring(radius=6.0, height=3.0):
    """Cameras around a cloud; each shows every point."""
    angles = np.linspace(0.0, 2.0 * np.pi, VIEWS, endpoint=False)
    centers = np.column_stack([radius * np.cos(angles), radius * np.sin(angles)])
    cloud = np.random.default_rng(0).uniform(-1, 1, (POINTS, 3))
    views = [
        posed_view((x, y, height), f"{i:02}.png", forward=(-x, -y, -height), seen=range(POINTS))
        for i, (x, y) in enumerate(centers)
    ]
    return posed_scene(views, cloud)


def observed(scene, sheen, per_point=12, gains=None):
    """Observations with noise of 0.1 stops, and `sheen` stops for each unit of a direction."""
    rng = np.random.default_rng(1)
    gains = np.zeros(VIEWS) if gains is None else gains
    points = np.repeat(np.arange(POINTS), per_point)
    photos = np.concatenate([rng.choice(VIEWS, per_point, replace=False) for _ in range(POINTS)])
    directions = scene.centers[photos] - scene.points[points]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    tilt = rng.normal(size=(POINTS, 3))
    stops = rng.normal(-2, 1, POINTS)[points] + sheen * (tilt[points] * directions).sum(axis=1)
    stops += gains[photos] + rng.normal(0, 0.1, len(points))
    return Observations(photos, points, stops, np.arange(POINTS))


def decided(scene, found, monkeypatch, **given):
    monkeypatch.setattr(view_dependence, "observations_of", lambda *_: found)
    return appearance.degree(Evidence(configured({"scene": "nowhere", **given}), scene))


def test_the_leave_one_out_error_agrees_with_a_loop():
    count, tracks = 9, 5
    stops = RNG.normal(size=(tracks, count))
    directions = RNG.normal(size=(tracks, count, 3))
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    found = view_dependence._errors(stops, directions)
    for row, (y, x) in enumerate(zip(stops, directions, strict=True)):
        errors = []
        for left in range(count):
            rest = np.arange(count) != left
            design = np.column_stack([np.ones(count), x])
            penalty = view_dependence._RIDGE * count * np.diag([0.0, 1.0, 1.0, 1.0])
            part = design[rest]
            fit = np.linalg.solve(part.T @ part + penalty, part.T @ y[rest])
            errors.append([y[left] - y[rest].mean(), y[left] - design[left] @ fit])
        assert found[row] == pytest.approx((np.array(errors) ** 2).mean(axis=0))


def test_matte_points_need_no_sh_bands(monkeypatch):
    scene = ring()
    found = decided(scene, observed(scene, 0.0), monkeypatch)
    assert (found.choice, found.basis) == ("0", "decided")
    assert dict(found.settings) == {"backbone.sh_degree": 0}
    assert found.figures["high"] < appearance.LEAST_SHARE
    assert found.saved == "45 of 59 numbers of a Gaussian"


def test_exposure_differences_do_not_count_as_view_dependence(monkeypatch):
    scene = ring()
    gains = np.random.default_rng(4).normal(0, 1.5, VIEWS)
    found = decided(scene, observed(scene, 0.0, gains=gains), monkeypatch)
    assert found.choice == "0"


def test_a_glossy_surface_keeps_the_sh_bands(monkeypatch):
    scene = ring()
    found = decided(scene, observed(scene, 0.3), monkeypatch)
    assert (found.choice, found.basis) == ("3", "decided")
    assert found.figures["low"] > 0.3
    assert not found.settings


@pytest.mark.parametrize("per_point", [2, view_dependence.LEAST_OBSERVATIONS - 1])
def test_short_tracks_decide_nothing_about_sh_bands(per_point, monkeypatch):
    scene = ring()
    found = decided(scene, observed(scene, 0.0, per_point), monkeypatch)
    assert (found.choice, found.basis) == ("3", "default")
    assert found.figures["tracks"] == 0


def test_viewing_directions_in_a_narrow_cone_decide_nothing_about_sh_bands(monkeypatch):
    scene = ring(radius=1.0, height=40.0)
    found = decided(scene, observed(scene, 0.0), monkeypatch)
    assert found.basis == "default"


@pytest.mark.parametrize(
    ("figures", "choice", "basis"),
    [
        ((500, 0.0, -0.01, 0.01), "0", "decided"),
        ((500, 0.01, -0.01, 0.03), "3", "default"),
        ((500, 0.05, 0.03, 0.08), "3", "decided"),
        ((view_dependence.FEWEST_TRACKS - 1, 0.0, -0.01, 0.01), "3", "default"),
        ((500, np.nan, np.nan, np.nan), "3", "default"),
    ],
)
def test_the_whole_interval_of_view_dependence_decides_about_sh_bands(
    figures, choice, basis, monkeypatch
):
    measured = view_dependence.ViewDependence(*figures)
    monkeypatch.setattr(view_dependence, "view_dependence", lambda scene: measured)
    found = appearance.degree(Evidence(configured({"scene": "nowhere"}), ring()))
    assert (found.choice, found.basis) == (choice, basis)


def test_an_sh_degree_of_the_user_is_kept(monkeypatch):
    scene = ring()
    mine = {"backbone": {"name": "vanilla", "sh_degree": 2}}
    found = decided(scene, observed(scene, 0.0), monkeypatch, **mine)
    assert (found.choice, found.basis) == ("2", "given")
    assert not found.settings


def test_sh_bands_are_kept_if_the_user_sets_sparse_sh(monkeypatch):
    scene = ring()
    found = decided(scene, observed(scene, 0.0), monkeypatch, rules={"sparse-sh": {"every": 4}})
    assert found.basis == "given"
    assert not found.settings

"""The similarity from points to measured ones: exact, with errors, some of them wrong, or none."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from crossgrad_plugins.georeference.frames import Fit, Frame3D, fit_similarity, similarity_of

SEEDS = st.integers(0, 2**32 - 1)


def case(seed, count, noise=0.0, flat=1.0):
    """A similarity, points and where it brings them, off by normal errors."""
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(random_state=rng).as_matrix()
    frame = Frame3D(rotation, rng.normal(size=3) * 1e3, float(np.exp(rng.uniform(-4, 4))))
    points = rng.normal(size=(count, 3)) * [1.0, 0.7, flat] + rng.normal(size=3) * 10.0
    errors = rng.normal(size=(count, 3)) * noise * frame.scale
    return frame, points, frame.points(points) + errors, rng


def apart(found, expected, points):
    """How far two similarities bring points apart, at most."""
    return np.abs(found.points(points) - expected.points(points)).max()


@settings(max_examples=40)
@given(SEEDS, st.integers(3, 30), st.floats(0.0, 1.0))
@example(582, 9, 0.0)  # All residuals were above their own median by rounding.
def test_an_exact_similarity_transform_is_found(seed, count, flat):
    frame, points, measured, _ = case(seed, count, flat=flat)
    fit = fit_similarity(points, measured)
    if isinstance(fit, str):  # Three points may lie on a line.
        assert np.linalg.svd(points - points.mean(axis=0))[1][1] < 0.1
        return
    assert fit.kept.all()
    assert apart(fit.frame, frame, points) <= 1e-7 * (1.0 + frame.scale)


@settings(max_examples=12)
@given(SEEDS)
def test_the_fit_with_errors_is_the_least_squares_solution(seed):
    frame, points, measured, _ = case(seed, 7, noise=0.05)

    def residuals(numbers):
        rotation = Rotation.from_rotvec(numbers[:3]).as_matrix() @ frame.rotation
        tried = Frame3D(rotation, numbers[3:6] + frame.shift, frame.scale * np.exp(numbers[6]))
        return ((measured - tried.points(points)) / frame.scale).ravel()

    best = least_squares(residuals, np.zeros(7), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    fit = fit_similarity(points, measured)
    assert isinstance(fit, Fit)
    found = float((fit.errors**2).sum()) / frame.scale**2
    assert found == pytest.approx(2.0 * best.cost, rel=1e-6)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("count", [8, 12, 60])
def test_outliers_are_left_out_of_the_fit(seed, count):
    _, points, measured, rng = case(seed, count, noise=0.01)
    frame = case(seed, count)[0]
    wrong = rng.permutation(count)[: count // 4]
    measured[wrong] += frame.scale * rng.normal(size=(len(wrong), 3)) * 1e3
    fit = fit_similarity(points, measured)
    assert isinstance(fit, Fit)
    assert not fit.kept[wrong].any()
    right = np.setdiff1d(np.arange(count), wrong)
    # One of the right ones may look wrong where there are few.
    assert (~fit.kept[right]).sum() <= 1
    assert apart(fit.frame, frame, points[right]) <= 0.05 * frame.scale


@pytest.mark.parametrize("seed", range(5))
def test_nearly_half_of_the_points_may_be_wrong_even_in_the_same_direction(seed):
    """An example is one folder of photos whose GPS receiver had a constant offset."""
    _, points, measured, rng = case(seed, 60, noise=0.01)
    frame = case(seed, 60)[0]
    wrong = rng.permutation(60)[:26]
    measured[wrong] += frame.scale * np.array([3.0, -2.0, 0.5])
    fit = fit_similarity(points, measured)
    assert isinstance(fit, Fit)
    right = np.setdiff1d(np.arange(60), wrong)
    assert not fit.kept[wrong].any()
    assert apart(fit.frame, frame, points[right]) <= 0.05 * frame.scale


@pytest.mark.parametrize("seed", range(20))
def test_no_point_is_left_out_without_outliers(seed):
    _, points, measured, _ = case(seed, 20, noise=0.1)
    assert fit_similarity(points, measured).kept.all()


@pytest.mark.parametrize("count", [3, 6, 40])
def test_points_on_one_line_give_no_similarity(count):
    along = np.linspace(0.0, 1.0, count)[:, None]
    points = along * [1.0, 2.0, 3.0]
    measured = along * [300.0, -100.0, 0.0]
    assert "on a line" in fit_similarity(points, measured)
    # A line that is one up to the errors of what was measured.
    rng = np.random.default_rng(0)
    points += rng.normal(size=(count, 3)) * 1e-3
    measured += rng.normal(size=(count, 3)) * 2.0
    assert "on a line" in fit_similarity(points, measured)


def test_coinciding_points_give_no_similarity():
    points, here = np.random.default_rng(0).normal(size=(9, 3)), np.full((9, 3), 5.0)
    assert "at the same position" in fit_similarity(points, here)
    assert "at the same position" in fit_similarity(here, points)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_fewer_than_three_points_give_no_similarity(count):
    assert f"there are {count} of them" in fit_similarity(np.eye(3)[:count], np.eye(3)[:count])


@pytest.mark.parametrize("seed", range(3))
def test_the_estimated_rotation_error_agrees_with_repeated_fits(seed):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(12, 3)) * [10.0, 1.0, 0.2]
    turns, told = [], []
    for _ in range(40):
        fit = fit_similarity(points, points + rng.normal(size=(12, 3)) * 0.05)
        axis = Rotation.from_matrix(fit.frame.rotation).as_rotvec()
        turns.append(axis @ np.linalg.svd(points - points.mean(axis=0))[2][0])
        told.append(fit.tilt)
    assert np.sqrt(np.mean(np.square(turns))) == pytest.approx(np.mean(told), rel=0.4)


@given(SEEDS)
def test_the_matrix_of_a_similarity_is_recognised(seed):
    frame = case(seed, 1)[0]
    found = similarity_of(frame.matrix)
    np.testing.assert_allclose(found.matrix, frame.matrix, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    "matrix",
    [
        np.diag([1.0, 1.0, 1.01, 1.0]),
        np.diag([1.0, 1.0, -1.0, 1.0]),
        np.diag([0.0, 0.0, 0.0, 1.0]),
        np.diag([1.0, 1.0, 1.0, 2.0]),
        np.full((4, 4), np.nan),
    ],
)
def test_uneven_mirrored_or_projective_matrices_are_not_similarities(matrix):
    assert similarity_of(matrix) is None

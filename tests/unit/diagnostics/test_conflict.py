"""Conflict rates, gradient ratios, exponents, conflict by distance."""

import numpy as np
import pytest

from crossgrad_plugins.diagnostics.distances import conflict_by_distance
from crossgrad_plugins.diagnostics.grouped import geometric_mean, gradient_ratio
from crossgrad_plugins.diagnostics.table import conflict, distance_exponent

NEAR = np.array([True, True, False, False])


def gramians(*blocks):
    return np.stack([np.array(rows) @ np.array(rows).T for rows in blocks])


def test_the_conflict_rate_is_reported_in_both_definitions():
    found = conflict(
        gramians(
            [[1.0], [1.0], [-1.0], [2.0]],
            [[1.0, 0.0], [1.0, 1.0], [-1.0, 0.5], [-1.0, -1.0]],
        ),
        NEAR,
    )
    assert found.per_block.tolist() == [0.5, 1.0]
    assert found.pairs.tolist() == [4, 4]
    # Pairs (near, far): both blocks, second only, both, second only.
    assert found.per_pair == pytest.approx((1.0 + 0.5 + 1.0 + 0.5) / 4)


def test_zero_and_disjoint_gradients_are_not_counted_as_agreement():
    rows = [[1.0, 0.0], [0.0, 0.0], [0.0, 1.0], [-1.0, 1.0]]
    found = conflict(gramians(rows), NEAR)
    assert found.pairs.tolist() == [1]
    assert found.disjoint.tolist() == [1]
    assert found.zero.tolist() == [2]
    assert found.per_block.tolist() == [1.0]


def test_orthogonal_gradients_with_overlap_are_counted():
    rows = [[1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, 1.0]]
    overlap = np.ones((1, 4, 4), dtype=bool)
    found = conflict(gramians(rows), NEAR, overlap)
    assert found.pairs.tolist() == [4]
    assert found.per_block.tolist() == [0.0]


def test_the_conflict_rate_is_undefined_without_counted_pairs():
    found = conflict(np.zeros((2, 4, 4)), NEAR)
    assert np.isnan(found.per_block).all()
    assert np.isnan(found.per_pair)


def test_the_near_to_far_gradient_ratio_is_a_ratio_of_means():
    ratio = gradient_ratio(np.array([4.0, 36.0, 1.0, 9.0]), NEAR)
    assert ratio.of_means == pytest.approx((2 + 6) / (1 + 3))
    assert ratio.median == pytest.approx(2.0)


def test_zero_gradients_count_in_the_means_and_form_no_pairs():
    ratio = gradient_ratio(np.array([4.0, 0.0, 1.0, 9.0]), NEAR)
    assert ratio.of_means == pytest.approx((2 + 0) / (1 + 3))
    assert ratio.median == pytest.approx(np.sqrt(2 * 2 / 3))


@pytest.mark.parametrize("squared", [[4.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]])
def test_without_nonzero_far_gradients_the_gradient_ratio_is_undefined(squared):
    ratio = gradient_ratio(np.array(squared), NEAR)
    assert np.isnan(ratio.of_means)
    assert np.isnan(ratio.median)


def test_ratios_are_averaged_by_their_geometric_mean():
    assert geometric_mean((2.0, 8.0)) == pytest.approx(4.0)
    assert np.isnan(geometric_mean((2.0, float("nan"))))


@pytest.mark.parametrize("exponent", [-1.0, 0.0, 2.0])
def test_an_exact_power_law_is_found_exactly(exponent):
    distances = np.geomspace(0.1, 10.0, 9)
    found = distance_exponent((3.0 * distances**-exponent) ** 2, distances)
    assert found.value == pytest.approx(exponent, abs=1e-9)
    assert found.interval.high - found.interval.low < 1e-6
    assert found.views == 9


def test_the_interval_of_the_exponent_has_its_coverage_under_unequal_scatter():
    rng = np.random.default_rng(0)
    distances = np.geomspace(1.0, 9.0, 24)
    held = 0
    for _ in range(400):
        noise = rng.normal(size=24) * np.linspace(0.1, 1.0, 24)
        lengths = np.exp(noise) * distances**-1.5
        held += distance_exponent(lengths**2, distances).interval.holds(1.5)
    assert 0.90 < held / 400 < 0.99


@pytest.mark.parametrize(
    ("squared", "distances"),
    [
        pytest.param([1.0, 2.0, 3.0], [1.0, 2.0, 3.0], id="three views"),
        pytest.param([1.0, 2.0, 3.0, 4.0], [2.0] * 4, id="one distance"),
        pytest.param([0.0] * 5, [1.0, 2.0, 3.0, 4.0, 5.0], id="zero gradients"),
    ],
)
def test_without_a_fitted_line_the_exponent_is_nan(squared, distances):
    found = distance_exponent(np.array(squared), np.array(distances))
    assert np.isnan([found.value, found.interval.low, found.interval.high]).all()


def test_the_exponent_fit_leaves_out_zero_gradients_and_zero_distances():
    distances = np.array([0.0, 1.0, 2.0, 4.0, 8.0, 16.0])
    squared = np.array([5.0, 1.0, 0.25, 0.0625, 0.015625, 0.0])
    found = distance_exponent(squared, distances)
    assert found.value == pytest.approx(1.0)
    assert found.views == 4


def opposing(distances):
    """Gradients that agree at equal distances and oppose at distances far apart."""
    angles = np.pi * np.log(distances) / np.log(distances.max() / distances.min())
    rows = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return rows @ rows.T


def test_conflict_that_grows_with_the_difference_of_camera_distances_is_found():
    distances = np.geomspace(1.0, 20.0, 16)
    found = conflict_by_distance(opposing(distances), distances, np.random.default_rng(0))
    assert found.correlation > 0.5
    assert found.p_value < 0.01
    assert found.rates[0] == 0.0
    assert found.rates[-1] == 1.0


def test_conflict_independent_of_distances_is_not_reported():
    rng = np.random.default_rng(1)
    values = []
    for _ in range(40):
        rows = rng.normal(size=(12, 3))
        distances = rng.uniform(1.0, 5.0, 12)
        values.append(conflict_by_distance(rows @ rows.T, distances, rng, permutations=99).p_value)
    assert 0.3 < np.mean(values) < 0.7


@pytest.mark.parametrize(
    "gramian", [np.zeros((5, 5)), np.ones((5, 5))], ids=["no pairs", "no conflict"]
)
def test_constant_conflict_has_no_correlation(gramian):
    distances = np.arange(1.0, 6.0)
    found = conflict_by_distance(gramian, distances, np.random.default_rng(0))
    assert np.isnan([found.correlation, found.p_value]).all()


@pytest.mark.parametrize("views", [4, 6, 8])
def test_permutations_that_equal_the_observed_statistic_count_despite_rounding(views):
    # One pair conflicts, the nearest camera with the farthest one: no other is as far apart.
    pairs, values = views * (views - 1) / 2, []
    for seed in range(20):
        distances = np.exp(np.random.default_rng(seed).normal(size=views))
        near, far = distances.argmin(), distances.argmax()
        gramian = np.full((views, views), 0.5) + np.eye(views)
        gramian[near, far] = gramian[far, near] = -0.3
        rng = np.random.default_rng(seed)
        values.append(conflict_by_distance(gramian, distances, rng).p_value)
    # 20 draws of 499 relabellings each: three standard errors of their mean.
    share = 1.0 / pairs
    assert np.mean(values) == pytest.approx(share, abs=3 * np.sqrt(share / 499 / 20) + 1 / 500)


def test_pairs_of_views_with_equal_distances_have_equal_ranks():
    # Two rings whose radii differ by rounding, in conflict between them.
    radii = np.repeat([1.0, 3.0], 8) * (1 + 1e-15 * np.random.default_rng(0).normal(size=16))
    sides = np.repeat([1.0, -1.0], 8)
    found = conflict_by_distance(np.outer(sides, sides), radii, np.random.default_rng(0))
    assert found.correlation == pytest.approx(1.0, abs=1e-12)

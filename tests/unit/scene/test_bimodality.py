"""Sarle's coefficient: published values, limits, laws."""

import numpy as np
import pytest
from scipy.stats import expon, kurtosis, norm, skew

from crossgrad_core.scene.bimodality import bimodality


def quantiles(law, n=200_000):
    return law.ppf((np.arange(n) + 0.5) / n)


def two_points(n):
    return np.array([0.0, 1.0] * (n // 2))


@pytest.mark.parametrize(
    ("n", "expected"), [(10, 0.566), (100, 0.951), (200, 0.975), (500, 0.990), (1000, 0.995)]
)
def test_the_finite_sample_coefficient_of_two_equal_groups_is_below_one(n, expected):
    found = bimodality(two_points(n))
    assert found.sample == pytest.approx(expected, abs=5e-4)
    assert found.population == pytest.approx(1.0)
    assert found.size == n


@pytest.mark.parametrize("share", [0.5, 0.2, 0.01])
def test_every_distribution_on_two_points_has_a_population_coefficient_of_one(share):
    values = np.array([0.0] * round(1000 * share) + [1.0] * round(1000 * (1 - share)))
    assert bimodality(values).population == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        pytest.param(np.linspace(0.0, 1.0, 200_000), 5 / 9, id="uniform"),
        pytest.param(quantiles(norm), 1 / 3, id="normal"),
        pytest.param(quantiles(expon), 5 / 9, id="exponential"),
    ],
)
def test_known_distributions_have_the_expected_coefficients(values, expected):
    found = bimodality(values)
    assert found.population == pytest.approx(expected, abs=2e-3)
    assert found.sample == pytest.approx(expected, abs=2e-3)


@pytest.mark.parametrize("seed", range(5))
def test_both_bimodality_coefficients_are_computed_from_standard_moments(seed):
    values = np.random.default_rng(seed).gamma(2.0, size=23)
    n = len(values)
    g1, g2 = skew(values, bias=False), kurtosis(values, bias=False)
    expected = (g1**2 + 1) / (g2 + 3 * (n - 1) ** 2 / ((n - 2) * (n - 3)))
    assert bimodality(values).sample == pytest.approx(expected)
    expected = (skew(values) ** 2 + 1) / (kurtosis(values) + 3)
    assert bimodality(values).population == pytest.approx(expected)


@pytest.mark.parametrize(("scale", "shift"), [(1e-150, 0.0), (1e150, 0.0), (-3.0, 1e6)])
def test_the_unit_of_the_values_does_not_change_the_bimodality_coefficient(scale, shift):
    values = np.random.default_rng(0).normal(size=40)
    found, moved = bimodality(values), bimodality(scale * values + shift)
    assert moved.sample == pytest.approx(found.sample, rel=1e-6)
    assert moved.population == pytest.approx(found.population, rel=1e-6)


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        pytest.param([1.0, 2.0, 3.0], "3 values", id="too few"),
        pytest.param([], "0 values", id="none"),
        pytest.param([0.1] * 7, "equal", id="equal"),
        pytest.param([0.0] * 5, "equal", id="zero"),
    ],
)
def test_values_without_a_bimodality_coefficient_give_the_reason(values, reason):
    found = bimodality(np.array(values))
    assert np.isnan([found.sample, found.population]).all()
    assert reason in found.reason

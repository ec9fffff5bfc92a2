"""sigma_w^2, sigma_b^2 and the noise scale: unbiased, invariant, right at the edges."""

from itertools import combinations, product

import numpy as np
import pytest

from crossgrad_core.errors import UserError
from crossgrad_plugins.diagnostics.grouped import Groups, variance_split
from crossgrad_plugins.diagnostics.table import noise_scale

NEAR_CAMERAS, FAR_CAMERAS, DIMENSION = 5, 6, 4


def population(seed=0):
    rng = np.random.default_rng(seed)
    near = rng.normal(size=(NEAR_CAMERAS, DIMENSION)) + 2.0
    far = 1.5 * rng.normal(size=(FAR_CAMERAS, DIMENSION)) + rng.normal(size=DIMENSION)
    return near, far


def groups(near, far, **options):
    return Groups(np.array([True] * near + [False] * far), **options)


def split(near, far, **options):
    rows = np.concatenate([near, far])
    return variance_split(rows @ rows.T, groups(len(near), len(far), **options))


def plain_variance(rows):
    return ((rows - rows.mean(axis=0)) ** 2).sum(axis=1).mean()


@pytest.mark.parametrize("drawn", [(2, 2), (2, 4), (4, 3)])
@pytest.mark.parametrize("shares", [(0.5, 0.5), (5 / 11, 6 / 11), (0.8, 0.2)])
def test_estimates_from_probes_without_replacement_are_unbiased(drawn, shares):
    near, far = population()
    found = [
        split(near[list(i)], far[list(j)], cameras=(len(near), len(far)), shares=shares)
        for i, j in product(
            combinations(range(len(near)), drawn[0]), combinations(range(len(far)), drawn[1])
        )
    ]
    p, q = shares
    gap = ((near.mean(axis=0) - far.mean(axis=0)) ** 2).sum()
    within = p * plain_variance(near) + q * plain_variance(far)
    assert np.mean([each.within for each in found]) == pytest.approx(within)
    assert np.mean([each.between for each in found]) == pytest.approx(p * q * gap)


def test_estimates_from_independent_probes_are_unbiased():
    # Every equally likely outcome of independent draws from a law on three points, two per group.
    points = np.array([[0.0, 1.0], [3.0, 1.0], [0.0, -5.0]])
    shift = np.array([1.0, 2.0])
    found = [
        split(points[list(i)], points[list(j)] + shift)
        for i, j in product(product(range(3), repeat=2), repeat=2)
    ]
    assert np.mean([each.within for each in found]) == pytest.approx(plain_variance(points))
    assert np.mean([each.between for each in found]) == pytest.approx((shift**2).sum() / 4)


def test_a_gradient_probe_of_all_cameras_gives_the_numbers_of_the_paper():
    near, far = population()
    found = split(near, far, cameras=(len(near), len(far)))
    assert found.within == pytest.approx((plain_variance(near) + plain_variance(far)) / 2)
    gap = ((near.mean(axis=0) - far.mean(axis=0)) ** 2).sum()
    assert found.between == pytest.approx(gap / 4)
    assert found.ratio == pytest.approx(found.between / found.within)


def test_the_proposition_of_the_paper_holds_for_the_estimates():
    near, far = population()[0], population()[1][:NEAR_CAMERAS]
    found = split(near, far, cameras=(NEAR_CAMERAS, NEAR_CAMERAS))
    both = np.concatenate([near, far])
    random = np.array([(a + b) / 2 for a, b in product(both, repeat=2)])
    structured = np.array([(a + b) / 2 for a, b in product(near, far)])
    assert plain_variance(random) == pytest.approx((found.within + found.between) / 2)
    assert plain_variance(structured) == pytest.approx(found.within / 2)


def test_the_order_of_the_views_does_not_matter():
    near, far = population()
    rows = np.concatenate([near, far])
    order = np.random.default_rng(1).permutation(len(rows))
    mixed = Groups((np.arange(len(rows)) < len(near))[order])
    found = variance_split(rows[order] @ rows[order].T, mixed)
    assert found.within == pytest.approx(split(near, far).within)
    assert found.between == pytest.approx(split(near, far).between)


@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_estimates_scale_with_the_squared_gradients(scale):
    near, far = population()
    found, scaled = split(near, far), split(scale * near, scale * far)
    assert scaled.within == pytest.approx(scale**2 * found.within)
    assert scaled.between == pytest.approx(scale**2 * found.between)


def test_a_constant_added_to_all_gradients_does_not_change_the_estimates():
    near, far = population()
    moved = split(near + 1e3, far + 1e3)
    assert moved.within == pytest.approx(split(near, far).within)
    assert moved.between == pytest.approx(split(near, far).between)


def test_estimates_of_several_probes_are_added():
    near, far = population()
    other = population(seed=5)
    rows, others = np.concatenate([near, far]), np.concatenate(other)
    total = variance_split(rows @ rows.T + others @ others.T, groups(len(near), len(far)))
    assert total.within == pytest.approx(split(near, far).within + split(*other).within)
    assert total.between == pytest.approx(split(near, far).between + split(*other).between)


def test_the_estimate_of_sigma_b_is_not_clipped_at_zero():
    rng = np.random.default_rng(0)
    found = [split(*rng.normal(size=(2, 3, 8))).between for _ in range(200)]
    assert min(found) < 0 < max(found)


def test_zero_gradients_have_no_variance_ratio():
    found = split(np.zeros((3, 4)), np.zeros((3, 4)))
    assert (found.within, found.between) == (0.0, 0.0)
    assert np.isnan(found.ratio)


@pytest.mark.parametrize("sizes", [(1, 3), (4, 0), (0, 2)])
def test_a_group_with_one_view_is_a_user_error(sizes):
    with pytest.raises(UserError, match="each group needs two views"):
        groups(*sizes)


@pytest.mark.parametrize("shares", [(0.5, 0.5), (0.7, 0.3)])
def test_the_noise_scale_is_the_gradient_variance_divided_by_the_squared_mean(shares):
    near, far = population()
    rows = np.concatenate([near, far])
    census = groups(len(near), len(far), cameras=(len(near), len(far)), shares=shares)
    p, q = shares
    mean = p * near.mean(axis=0) + q * far.mean(axis=0)
    variance = p * plain_variance(near) + q * plain_variance(far)
    variance += p * q * ((near.mean(axis=0) - far.mean(axis=0)) ** 2).sum()
    expected = variance / (mean**2).sum()
    assert noise_scale(rows @ rows.T, census) == pytest.approx(expected)


def test_the_signal_estimate_of_the_noise_scale_is_unbiased():
    # Far from zero, so that no outcome's signal is negative and can be read off the noise scale.
    near, far = (rows + 50.0 for rows in population())
    signals = []
    for i, j in product(combinations(range(len(near)), 2), combinations(range(len(far)), 3)):
        rows = np.concatenate([near[list(i)], far[list(j)]])
        drawn = groups(2, 3, cameras=(len(near), len(far)))
        found = variance_split(rows @ rows.T, drawn)
        signals.append((found.within + found.between) / noise_scale(rows @ rows.T, drawn))
    mean = (near.mean(axis=0) + far.mean(axis=0)) / 2
    assert np.mean(signals) == pytest.approx(mean @ mean)


def test_a_zero_mean_gives_an_infinite_noise_scale_and_zero_variance_gives_nan():
    opposed = np.array([[1.0], [-1.0], [1.0], [-1.0]])
    assert noise_scale(opposed @ opposed.T, groups(2, 2)) == float("inf")
    equal = np.ones((4, 1))
    assert np.isnan(noise_scale(equal @ equal.T, groups(2, 2)))

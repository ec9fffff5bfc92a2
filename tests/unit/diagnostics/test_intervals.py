"""Intervals of the variance split: coverage, invariances, edges."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from crossgrad_plugins.diagnostics.grouped import GroupedGramian, Groups, split_of, variance_split
from crossgrad_plugins.diagnostics.intervals import Interval, StudentisedGap, split_intervals
from crossgrad_plugins.diagnostics.resampling import Resamples, multiplicities


def benchmark():
    path = Path(__file__).parents[3] / "benchmarks" / "interval_coverage.py"
    spec = importlib.util.spec_from_file_location("interval_coverage", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


COVERAGE = benchmark().coverage
REPETITIONS = 120
#: Three standard errors of a share of 0.95 in so many repetitions.
SLACK = 3 * (0.95 * 0.05 / REPETITIONS) ** 0.5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "dimension", "sizes", "ratio"),
    [
        ("normal", 30, (12, 12), 0.1),
        ("normal", 300, (8, 8), 1.0),
        ("decaying", 30, (8, 24), 1.0),
        ("finite", 30, (12, 12), 0.1),
    ],
)
def test_intervals_contain_the_true_value_with_the_stated_coverage(kind, dimension, sizes, ratio):
    held = COVERAGE(kind, dimension, sizes, ratio, REPETITIONS)
    assert (held > 0.95 - SLACK).all()


def test_confidence_intervals_are_not_too_wide():
    # An interval that held everything would pass the test above.
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(24, 300))
    rows[12:] += 0.5
    groups = Groups(np.arange(24) < 12)
    found = split_intervals(rows @ rows.T, groups, rng)
    assert found.within.high / found.within.low < 1.3
    assert 0.5 * 18.75 < found.between.low < 18.75 < found.between.high < 1.5 * 18.75


@pytest.mark.slow
@pytest.mark.parametrize("sizes", [(8, 8), (12, 12)])
@pytest.mark.parametrize(
    ("kind", "dimension", "lowest"), [("normal", 30, 0.92), ("radial5", 30, 0.88)]
)
def test_coverage_over_a_thousand_repetitions_is_within_the_accepted_range(
    kind, dimension, lowest, sizes
):
    within, between, _ = COVERAGE(kind, dimension, sizes, 1.0, 1000)
    assert lowest <= within <= 0.98
    assert lowest <= between <= 0.98


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "dimension", "ratio", "figure", "lowest"),
    [
        # The sample's gap points where gradients vary most: once 99 %.
        pytest.param("decaying", 30, 0.1, 1, 0.92, id="few directions dominate"),
        # Too few long gradients make sigma_w^2 too small: once 84 %.
        pytest.param("student3", 3, 1.0, 2, 0.88, id="ratio without a fourth moment"),
    ],
)
def test_coverage_of_the_hard_cases_is_within_the_accepted_range(
    kind, dimension, ratio, figure, lowest
):
    assert lowest <= COVERAGE(kind, dimension, (12, 12), ratio, 500)[figure] <= 0.98


@pytest.mark.parametrize("isotropic", [True, False])
def test_the_variance_that_the_interval_assumes_agrees_with_normal_theory(isotropic):
    """Compare the mean variance that the pivot assumes at the true gap with normal theory."""
    rng = np.random.default_rng(1)
    scales = np.ones(30) if isotropic else 1.0 / np.sqrt(1.0 + np.arange(30))
    # The gap lies where gradients vary least.
    gap = np.zeros(30)
    gap[-1] = 1.5
    groups = Groups(np.arange(24) < 12)
    assumed, plain = [], []
    for _ in range(250):
        rows = rng.normal(size=(24, 30)) * scales
        rows[12:] += gap
        parts = GroupedGramian.of(rows @ rows.T, groups)
        draws = Resamples.of(parts, groups, 20, rng)
        problem = StudentisedGap.of(parts, groups, draws)
        along = [d.shift_variance[0] * parts.scale for d in (problem.draws, draws)]
        floor = problem.floor * parts.scale**2
        assumed.append(4.0 * (gap @ gap) * along[0] + floor)
        plain.append(4.0 * (gap @ gap) * along[1] + floor)
    # 4 d' Sigma d + 2 tr(Sigma^2) for the difference of two means of twelve, less the diagonals.
    of_noise = (scales**4).sum() * (4.0 / (12 * 11) + 4.0 / (12 * 12))
    exact = 4.0 * (gap**2 * scales**2).sum() * (2.0 / 12.0) + of_noise
    if isotropic:
        assert np.mean(assumed) == pytest.approx(exact, rel=0.05)
    else:
        assert np.mean(assumed) > exact
        assert np.mean(assumed) - exact < 0.65 * (np.mean(plain) - exact)


def sample(seed=0, near=9, far=7, dimension=20, shift=0.3):
    rows = np.random.default_rng(seed).normal(size=(near + far, dimension))
    rows[:near] += shift
    return rows, np.arange(near + far) < near


def ends(rows, near, **options):
    found = split_intervals(rows @ rows.T, Groups(near, **options), np.random.default_rng(3))
    return np.array([(i.low, i.high) for i in (found.within, found.between, found.ratio)])


@pytest.mark.parametrize("scale", [1e-25, 1e25])
def test_confidence_intervals_scale_with_the_squared_gradients(scale):
    rows, near = sample()
    expected = ends(rows, near) * np.array([[scale**2], [scale**2], [1.0]])
    np.testing.assert_allclose(ends(scale * rows, near), expected, rtol=1e-5)


def test_a_constant_added_to_all_gradients_does_not_change_the_intervals():
    rows, near = sample()
    np.testing.assert_allclose(ends(rows + 100.0, near), ends(rows, near), rtol=1e-5)


def test_a_rotation_of_the_gradients_does_not_change_the_intervals():
    rows, near = sample()
    rotation = np.linalg.qr(np.random.default_rng(1).normal(size=(20, 20)))[0]
    np.testing.assert_allclose(ends(rows @ rotation, near), ends(rows, near), rtol=1e-5)


def test_confidence_intervals_contain_their_estimates():
    rows, near = sample()
    assert (ends(rows, near) == ends(rows, near)).all()


@pytest.mark.parametrize("seed", range(8))
def test_estimates_are_inside_their_intervals_if_possible(seed):
    rows, near = sample(seed)
    gramian, groups = rows @ rows.T, Groups(near)
    figures = variance_split(gramian, groups)
    found = split_intervals(gramian, groups, np.random.default_rng(0))
    assert found.within.holds(figures.within)
    assert found.between.holds(max(figures.between, 0.0))
    assert found.between.low >= 0.0


def test_only_a_wide_gap_between_groups_has_an_interval_above_zero():
    rows, near = sample(shift=3.0)
    assert ends(rows, near)[1, 0] > 0.0
    rows, near = sample(shift=0.0)
    assert ends(rows, near)[1, 0] == 0.0


def test_an_estimate_far_below_zero_has_no_interval():
    """Both groups contain the same views, so their means are equal."""
    rows = np.tile(np.random.default_rng(0).normal(size=(12, 300)), (2, 1))
    gramian, groups = rows @ rows.T, Groups(np.arange(24) < 12)
    found = split_intervals(gramian, groups, np.random.default_rng(0))
    assert variance_split(gramian, groups).between < 0.0
    assert np.isnan([found.between.low, found.between.high]).all()
    assert np.isnan([found.ratio.low, found.ratio.high]).all()
    assert not found.between.holds(0.0)
    assert found.within.low > 0.0


def test_probing_every_camera_gives_intervals_of_width_zero():
    rows, near = sample()
    groups = Groups(near, cameras=(9, 7))
    figures = variance_split(rows @ rows.T, groups)
    found = split_intervals(rows @ rows.T, groups, np.random.default_rng(0))
    assert found.within == Interval(figures.within, figures.within)
    assert found.between == Interval(figures.between, figures.between)
    assert found.ratio.low == pytest.approx(figures.ratio)


def test_probing_most_cameras_narrows_the_intervals():
    rows, near = sample()
    width = np.ptp(ends(rows, near), axis=1)
    assert (np.ptp(ends(rows, near, cameras=(10, 8)), axis=1) < 0.6 * width).all()


@pytest.mark.parametrize(
    "rows",
    [
        pytest.param(np.zeros((10, 3)), id="zero"),
        pytest.param(np.ones((10, 3)), id="equal"),
        pytest.param(np.random.default_rng(0).normal(size=(6, 3)), id="three views per group"),
    ],
)
def test_interval_ends_are_unknown_without_variance_or_views(rows):
    near = np.arange(len(rows)) < len(rows) // 2
    assert np.isnan(ends(rows, near)).all()


def test_every_resample_has_at_least_three_distinct_cameras_and_the_right_size():
    counts = multiplicities(4, 500, np.random.default_rng(0))
    assert (counts[0] == 1.0).all()
    assert (counts.sum(axis=1) == 4.0).all()
    assert (np.count_nonzero(counts, axis=1) >= 3).all()


def test_resampled_values_agree_with_values_of_the_resampled_gradients():
    rows, near = sample()
    groups = Groups(near)
    parts = GroupedGramian.of(rows @ rows.T, groups)
    draws = Resamples.of(parts, groups, 5, np.random.default_rng(2))
    # The same generator draws the same cameras: near group first, then far.
    rng = np.random.default_rng(2)
    counts = multiplicities(9, 5, rng), multiplicities(7, 5, rng)
    unit = np.trace(rows @ rows.T) / len(rows)
    gap = rows[near].mean(axis=0) - rows[~near].mean(axis=0)
    for r in range(6):
        spreads, means, shares, shifts = [], [], [], []
        for members, weights, sign in zip((rows[near], rows[~near]), counts, (1, -1), strict=True):
            w, n = weights[r], len(members)
            deviations = members - members.mean(axis=0)
            own = deviations / (n - 1)
            along = ((gap - sign * own) * deviations).sum(axis=1)
            shifts.append(sign * w @ (along - along.mean()) / n)
            pairs = [(i, j) for i in range(n) for j in range(n) if i != j]
            mass = sum(w[i] * w[j] for i, j in pairs)
            spreads.append(
                sum(w[i] * w[j] * ((members[i] - members[j]) ** 2).sum() / 2 for i, j in pairs)
                / mass
            )
            means.append(w @ deviations / n)
            shares.append((w**2).sum() / n**2)
        noise = ((means[0] - means[1]) ** 2).sum()
        noise -= sum(s * share for s, share in zip(spreads, shares, strict=True))
        assert draws.within[r] * unit == pytest.approx(sum(spreads) / 2)
        assert draws.noise[r] * unit == pytest.approx(noise)
        assert draws.shift[r] * np.sqrt(unit) == pytest.approx(sum(shifts) / np.linalg.norm(gap))
    assert split_of(parts, groups)[0] == pytest.approx(draws.within[0])

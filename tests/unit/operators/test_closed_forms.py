"""The result of each operator for two or three gradients, from the formulas of the papers."""

import numpy as np
import pytest

from crossgrad_core.registry.entries import build

ROOT = np.sqrt(2)
#: g1 = (1, 0), g2 = (-1, 1): a = 1, b = 2, m = -1, cos = -1/sqrt 2.
PAIR = np.array([[1.0, 0.0], [-1.0, 1.0]])

WEIGHTS = {
    "sum": (1, 1),
    "mean": (0.5, 0.5),
    # 1 - m / a and 1 - m / b.
    "symmetric": (2, 1.5),
    "pcgrad": (2, 1.5),
    "gradvac": (2, 1.5),
    "upgrad": (1, 0.75),
    # Mean (0, 1/2) already conflicts with neither.
    "dualproj": (0.5, 0.5),
    # (b - m) / (a + b - 2 m) = 3/5.
    "mgda": (0.6, 0.4),
    # (|g2|, |g1|) / (|g1| + |g2|).
    "imtl-g": (ROOT / (1 + ROOT), 1 / (1 + ROOT)),
    # 1 / (|g| sqrt(1 + cos)) times the geometric mean 2^(1/4) of the norms.
    "nash": (2**0.25 / np.sqrt(1 - 1 / ROOT), 2**0.25 / ROOT / np.sqrt(1 - 1 / ROOT)),
    "gradnorm": (1, 1),
    "preconditioner": (1, 1),
    "confgate": (1, 1),
    "dispatch": (1, 1),
    "anchors": (2, 1.5),
    "soft": (2, 1.5),
    "chain": (1, 1),
}


@pytest.mark.parametrize("name", WEIGHTS)
def test_weights_of_two_conflicting_gradients_agree_with_the_formulas(name, ask):
    np.testing.assert_allclose(ask(name, PAIR).weights, WEIGHTS[name], rtol=1e-14)


@pytest.mark.parametrize("name", ["symmetric", "pcgrad", "gradvac", "soft", "anchors", "chain"])
def test_gradients_without_conflict_are_added(name, ask):
    np.testing.assert_array_equal(ask(name, [[1.0, 0.5], [0.25, 1.0]]).weights, [1.0, 1.0])


def test_cagrad_solves_its_optimisation_problem_in_the_plane(ask):
    """Compare max over |d - g0| <= c |g0| of min g_k.d with a fine grid of directions."""
    pairs = (PAIR, np.array([[3.0, 1.0], [-1.0, 2.0]]), np.array([[1.0, 0.0], [-0.9, 0.1]]))
    for rows in pairs:
        mean = rows.mean(axis=0)
        angles = np.linspace(0, 2 * np.pi, 100_001)
        circle = mean + 0.5 * np.linalg.norm(mean) * np.stack([np.cos(angles), np.sin(angles)], 1)
        best = (circle @ rows.T).min(axis=1).max()
        found = ask("cagrad", rows).result
        assert np.linalg.norm(found - mean) <= 0.5 * np.linalg.norm(mean) * (1 + 1e-12)
        assert (rows @ found).min() >= best - 1e-9


def test_cagrad_of_three_is_never_worse_than_random_directions(ask):
    rng = np.random.default_rng(3)
    for _ in range(20):
        rows = rng.standard_normal((3, 3))
        mean = rows.mean(axis=0)
        ball = rng.standard_normal((5000, 3))
        ball *= 0.5 * np.linalg.norm(mean) / np.linalg.norm(ball, axis=1, keepdims=True)
        assert (rows @ ask("cagrad", rows).result).min() >= ((mean + ball) @ rows.T).min(1).max()


@pytest.mark.parametrize(("rescale", "factor"), [("1+c", 1.5), ("1+c^2", 1.25)])
def test_cagrad_is_rescaled_by_the_published_factors(rescale, factor, ask):
    plain = ask("cagrad", PAIR).weights
    scaled = ask(build("operators", "cagrad", {"rescale": rescale}), PAIR).weights
    np.testing.assert_allclose(scaled * factor, plain, rtol=1e-14)


def test_cagrad_with_radius_zero_is_the_mean(ask):
    weights = ask(build("operators", "cagrad", {"c": 0.0}), PAIR).weights
    np.testing.assert_array_equal(weights, [0.5, 0.5])


def test_cagrad_with_a_large_radius_tends_to_mgda(ask):
    found = ask(build("operators", "cagrad", {"c": 1e6}), PAIR).result
    other = ask("mgda", PAIR).result
    assert found @ other / np.linalg.norm(found) / np.linalg.norm(other) > 1 - 1e-10


def test_aligned_reduces_all_singular_values_to_the_smallest(ask):
    rows = np.array([[3.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 2.0]])
    np.testing.assert_allclose(ask("aligned", rows).result, [1 / 3, 1 / 3, 1 / 3], rtol=1e-14)


@pytest.mark.parametrize("views", [2, 3, 4, 7])
def test_imtl_g_has_equal_projections_on_all_gradients(views, ask):
    rows = np.random.default_rng(views).standard_normal((views, 12))
    rows *= np.arange(1, views + 1)[:, None]
    found = ask("imtl-g", rows)
    projections = rows @ found.result / np.linalg.norm(rows, axis=1)
    np.testing.assert_allclose(projections, projections[0], rtol=1e-11)
    assert found.weights.sum() == pytest.approx(1)


@pytest.mark.parametrize("views", [2, 3, 4, 9])
def test_nash_solves_the_bargaining_equation(views, ask):
    rows = np.random.default_rng(views).standard_normal((views, 20))
    norms = np.linalg.norm(rows, axis=1)
    alpha = ask("nash", rows).weights / np.exp(np.log(norms).mean())
    np.testing.assert_allclose(rows @ rows.T @ alpha, 1 / alpha, rtol=1e-11)


@pytest.mark.parametrize("views", [2, 3, 4, 7])
@pytest.mark.parametrize("name", ["mgda", "upgrad", "dualproj"])
def test_results_of_non_conflicting_operators_have_no_negative_dot_product_with_a_gradient(
    name, views, ask
):
    for seed in range(10):
        rows = np.random.default_rng(seed).standard_normal((views, 8)) + 0.1
        found = ask(name, rows).result
        assert (rows @ found).min() >= -1e-12 * np.linalg.norm(rows, axis=1).max() ** 2


@pytest.mark.parametrize("views", [3, 4, 5, 9])
def test_mgda_meets_the_optimality_conditions(views, ask):
    for seed in range(10):
        rows = np.random.default_rng(seed).standard_normal((views, 12)) - 0.1
        found = ask("mgda", rows)
        assert found.weights.min() >= 0
        assert found.weights.sum() == pytest.approx(1, rel=1e-12)
        assert (rows @ found.result).min() >= found.result @ found.result * (1 - 1e-10)


def test_soft_removes_a_share_of_the_conflicting_component(ask):
    half = build("operators", "soft", {"strength": 0.5})
    np.testing.assert_allclose(ask(half, PAIR).weights, [1.5, 1.25], rtol=1e-14)
    patient = build("operators", "soft", {"threshold": 0.8})
    np.testing.assert_array_equal(ask(patient, PAIR).weights, [1, 1])


def test_preconditioner_weights_by_squared_distance(ask):
    weights = ask("preconditioner", PAIR, distances=[2.0, 0.5]).weights
    np.testing.assert_allclose(weights, [4.0, 0.25])
    weights = ask("preconditioner", PAIR, distances=[1e6, 0.0]).weights
    np.testing.assert_allclose(weights, [1e4, 1e-4])


@pytest.mark.parametrize("labels", [("near", "near"), ("middle", "middle"), ("far", "middle")])
def test_anchors_project_only_between_a_near_and_a_far_view(labels, ask):
    np.testing.assert_array_equal(ask("anchors", PAIR, labels=labels).weights, [1, 1])


def test_symmetric_projects_each_of_three_gradients_against_the_other_original_gradients(ask):
    rows = np.array([[1.0, 0.0], [-1.0, 1.0], [-1.0, -2.0]])
    expected = np.zeros(2)
    for i in range(3):
        v = rows[i].copy()
        for j in range(3):
            if j != i and v @ rows[j] < 0:
                v -= v @ rows[j] / (rows[j] @ rows[j]) * rows[j]
        expected += v
    np.testing.assert_allclose(ask("symmetric", rows).result, expected, rtol=1e-13, atol=1e-14)

"""Edges that the methods' specification fixes: zero, opposite, and far apart gradients."""

import numpy as np
import pytest

E = np.array([0.6, -0.8, 0.0])
PROJECTING = ("symmetric", "pcgrad", "gradvac", "upgrad", "soft", "anchors")
VANISHING = ("mgda", "imtl-g", "nash")

#: Gradient-free second view: the weight of the first. Mean-type operators keep 1/2.
ALONE = {
    "sum": 1,
    "mean": 0.5,
    "symmetric": 1,
    "pcgrad": 1,
    "gradvac": 1,
    "upgrad": 0.5,
    "dualproj": 0.5,
    "cagrad": 0.5,
    "aligned": 0.5,
    "mgda": 1,
    "imtl-g": 1,
    "nash": 1,
    "gradnorm": 1,
    "confgate": 1,
    "soft": 1,
    "anchors": 1,
    "dispatch": 1,
    "preconditioner": 1,
}

#: g1 = 2e, g2 = -e: the result in units of e.
UNEQUAL = {
    "sum": 1,
    "mean": 0.5,
    **dict.fromkeys(PROJECTING, 0),
    **dict.fromkeys(VANISHING, 0),
    "dualproj": 0,
    "cagrad": 0.25,
    "aligned": 0.5,
    "gradnorm": 1,
}


@pytest.mark.parametrize("name", ALONE)
def test_a_view_without_a_gradient_is_left_out(name, ask):
    np.testing.assert_array_equal(ask(name, [3 * E, 0 * E]).weights, [ALONE[name], 0])


@pytest.mark.parametrize("name", sorted({*ALONE} - {"anchors"}))
def test_a_single_view_is_unchanged(name, ask):
    np.testing.assert_array_equal(ask(name, [3 * E]).weights, [1])


@pytest.mark.parametrize("name", ALONE)
def test_zero_gradients_give_a_zero_result(name, ask):
    np.testing.assert_array_equal(ask(name, [0 * E, 0 * E]).result, 0 * E)


@pytest.mark.parametrize("name", UNEQUAL)
def test_opposite_gradients_of_ratio_two_give_the_specified_result(name, ask):
    found = ask(name, [2 * E, -E])
    np.testing.assert_allclose(found.result, UNEQUAL[name] * E, rtol=1e-14, atol=0)


@pytest.mark.parametrize("name", sorted({*PROJECTING, *VANISHING, "cagrad", "aligned", "dualproj"}))
@pytest.mark.parametrize("factor", [1.0, 3.0, 1e-12, 1e9])
def test_exactly_opposite_gradients_leave_no_rounding_noise(name, factor, ask):
    expected = {"cagrad": (1 - factor) / 4, "aligned": (1 - factor) / 2}.get(name, 0.0)
    rounded = factor * E.astype(np.float32).astype(float)
    found = ask(name, [rounded / factor, -rounded]).result
    if expected:
        np.testing.assert_allclose(found, expected * rounded / factor, rtol=1e-9)
    else:
        np.testing.assert_array_equal(found, 0 * E)


def test_almost_opposite_gradients_count_as_opposite(ask):
    rows = [[1.0, 0.0], [-1.0, 1e-7]]
    for name in (*PROJECTING, *VANISHING):
        np.testing.assert_array_equal(ask(name, rows).result, [0, 0])


def test_a_length_ratio_of_1e12_keeps_the_projection_finite(ask):
    rows = np.array([[1.0, 0.0], [-0.5e-12, np.sqrt(0.75) * 1e-12]])
    np.testing.assert_allclose(ask("symmetric", rows).weights, [1, 5e11], rtol=1e-10)
    np.testing.assert_allclose(np.linalg.norm(ask("symmetric", rows).result), np.sqrt(0.75))
    bisector = 1e-12 * (rows[0] + rows[1] / 1e-12)
    np.testing.assert_allclose(ask("imtl-g", rows).result, bisector, rtol=1e-11)
    np.testing.assert_allclose(
        ask("cagrad", rows).result, rows[0] / 2 + 0.25 * rows[1] / 1e-12, rtol=1e-11
    )
    shortest = rows[1] - rows[1] @ rows[0] * rows[0]
    np.testing.assert_allclose(ask("mgda", rows).result, shortest, rtol=1e-11, atol=1e-24)
    np.testing.assert_allclose(
        ask("nash", rows).result, 1e-6 * (rows[0] + rows[1] / 1e-12) / np.sqrt(0.5), rtol=1e-11
    )


def test_aligned_drops_a_view_shorter_than_the_threshold(ask):
    below = np.array([[1.0, 0.0], [0.0, 1e-8]])
    np.testing.assert_allclose(ask("aligned", below).result, [0.5, 0.0], atol=1e-9)
    above = np.array([[1.0, 0.0], [0.0, 1e-7]])
    np.testing.assert_allclose(ask("aligned", above).result, [5e-8, 5e-8], rtol=1e-12)


def test_cagrad_gives_zero_if_a_combination_of_gradients_vanishes(ask):
    """Three gradients in one plane cancel: g_w = 0, so the direction is undefined."""
    rows = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0]])
    np.testing.assert_array_equal(ask("cagrad", rows).result, [0, 0])


@pytest.mark.parametrize("name", ["mgda", "nash", "upgrad", "dualproj", "imtl-g"])
def test_gradient_directions_that_cancel_give_a_zero_result(name, ask):
    angles = 2 * np.pi * np.arange(3) / 3
    rows = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    np.testing.assert_array_equal(ask(name, rows).result, [0, 0])

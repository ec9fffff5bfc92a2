"""Named operators that coincide."""

import numpy as np
import pytest

from crossgrad_core.registry.entries import build


def pairs():
    rng = np.random.default_rng(0)
    for _ in range(300):
        yield rng.standard_normal((2, 3)) * 10.0 ** rng.uniform(-8, 8, (2, 1))
    yield np.array([[1.0, 2.0, 0.0], [0.0, 0.0, 0.0]])
    yield np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 0.0]])
    yield np.array([[1.0, 2.0, 0.0], [-1.0, -2.0, 0.0]])


def same(one, other, rows):
    """Weights agree where they count: relative to the largest summand."""
    norms = np.linalg.norm(rows, axis=1)
    size = np.abs(one.weights * norms).max()
    np.testing.assert_allclose(one.weights * norms, other * norms, rtol=1e-12, atol=1e-12 * size)


@pytest.mark.sampled(3)
@pytest.mark.parametrize(
    ("name", "factor"),
    [("pcgrad", 1), ("upgrad", 2), ("gradvac", 1), ("anchors", 1), ("soft", 1)],
)
def test_operators_equal_the_symmetric_operator_up_to_a_factor_for_two_views(name, factor, ask):
    for rows in pairs():
        same(ask("symmetric", rows), factor * ask(name, rows).weights, rows)


def test_confgate_without_warmup_equals_symmetric(ask):
    open_gate = build("operators", "confgate", {"warmup": 0})
    for rows in pairs():
        same(ask("symmetric", rows), ask(open_gate, rows).weights, rows)


def test_nash_is_parallel_to_imtl_g(ask):
    for rows in pairs():
        one, other = ask("nash", rows).result, ask("imtl-g", rows).result
        lengths = np.linalg.norm(one), np.linalg.norm(other)
        if not lengths[0]:
            assert not lengths[1]
            continue
        assert one @ other / lengths[0] / lengths[1] == pytest.approx(1, abs=1e-12)


def test_soft_with_strength_zero_equals_sum(ask):
    weak = build("operators", "soft", {"strength": 0.0})
    for rows in pairs():
        present = rows.any(axis=1)
        np.testing.assert_array_equal(ask(weak, rows).weights, present.astype(float))

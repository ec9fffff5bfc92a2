"""Gradients that are short, of low rank or nearly alike: finite, bounded, as exact as others."""

from dataclasses import replace
from math import inf

import mpmath
import numpy as np
import pytest
import torch

from crossgrad_core.registry.entries import build
from crossgrad_operators.stress.cases import short
from crossgrad_operators.stress.promises import ALL
from crossgrad_operators.stress.runner import run_case
from crossgrad_operators.stress.search.families import Batch, results
from crossgrad_operators.stress.suite import made, reference_of
from crossgrad_operators.stress.verdict import ExactCase

TYPES = [torch.float32, torch.float64]
OURS = ("nash", "imtl-g", "aligned", "gradvac", "pcgrad", "symmetric", "soft", "confgate")


def judged(name, rows, dtype):
    """Relative error in units of u kappa; infinite where the verdict is not `ok`."""
    with mpmath.mp.workdps(50):
        operator = made(name)
        exact = ExactCase(short("drawn", rows, dtype))
        reference = replace(reference_of(name, operator), promise=ALL)
        finding = run_case(name, operator, exact, reference).finding
    return finding.error if finding.verdict in {"ok", "undetermined"} else inf


def short_rows(rng):
    """Gradients of few elements, of any sign, with exact dependencies."""
    views, size = rng.integers(2, 21), rng.integers(1, 5)
    return rng.integers(-2, 3, (views, size)).astype(float)


def of_low_rank(rng):
    views, rank = rng.integers(2, 21), rng.integers(1, 4)
    return rng.standard_normal((views, rank)) @ rng.standard_normal((rank, 50))


def nearly_alike(rng):
    """Near-duplicates and near-opposites at every distance."""
    views, size = rng.integers(2, 7), rng.integers(2, 20)
    row = rng.standard_normal(size) * rng.choice([-1.0, 1.0], (views, 1))
    return row + 10.0 ** -rng.uniform(0, 16) * rng.standard_normal((views, size))


def far_apart(rng):
    views, size = rng.integers(2, 7), rng.integers(1, 20)
    return rng.standard_normal((views, size)) * 10.0 ** rng.uniform(-6, 6, (views, 1))


FAMILIES = (short_rows, of_low_rank, nearly_alike, far_apart)


@pytest.mark.sampled(11)
@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family.__name__)
@pytest.mark.parametrize("name", OURS)
def test_random_degenerate_gramians_give_finite_weights(name, family, ask):
    rng = np.random.default_rng(1)
    operator = build("operators", name, {})
    for _ in range(200):
        assert np.isfinite(ask(operator, family(rng)).weights).all()


def test_nash_of_parallel_gradients_of_both_signs_is_zero(ask):
    rows = np.array([-1.0, -1, -1, 1, 1, 1, 1, 1])[:, None]
    np.testing.assert_array_equal(ask("nash", rows).weights, 0)


def test_nash_does_not_stop_between_damped_and_full_steps():
    rng = np.random.default_rng(2)
    for _ in range(12):
        assert judged("nash", of_low_rank(rng)[:7], torch.float32) <= 8


@pytest.mark.sampled(3)
@pytest.mark.parametrize("name", ["nash", "aligned"])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("dtype", TYPES)
def test_nearly_parallel_pairs_are_exact_at_every_distance(name, sign, dtype):
    for power in range(17):
        if sign < 0 and power in {5, 6}:
            # 1 + cos passes 1e-12 there, where the definition jumps.
            continue
        rows = [[1.0, 0.25], [sign, sign * 0.25 + 10.0**-power]]
        assert judged(name, rows, dtype) <= 8


@pytest.mark.sampled(13)
@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family.__name__)
@pytest.mark.parametrize("name", ["nash", "imtl-g", "aligned", "gradvac", "soft"])
@pytest.mark.parametrize("dtype", TYPES)
def test_results_for_random_gradients_agree_with_a_computation_in_50_digits(name, family, dtype):
    rng = np.random.default_rng(5)
    for _ in range(3):
        assert judged(name, family(rng)[:6], dtype) <= 8


def test_the_soft_operator_does_not_change_a_conflict_at_its_threshold():
    """The cosine is exactly -1/4, where the rule is discontinuous."""
    rows = [[1.0, 0, 0, 0, 0], [-1.0, 3, 2, 1, 1]]
    for scale in (1.0, 3.0, 7.0):
        assert judged("soft", np.array(rows) * [[scale], [1.0]], torch.float32) <= 8


def test_results_are_bounded_by_a_multiple_of_the_longest_gradient(ask):
    rng = np.random.default_rng(6)
    for family in FAMILIES:
        for _ in range(100):
            rows = family(rng)
            longest, views = np.linalg.norm(rows, axis=1).max(), len(rows)
            for name, factor in (("aligned", 1), ("nash", views**0.5), ("pcgrad", views)):
                length = np.linalg.norm(ask(name, rows).result)
                # Up to kappa = 7e5 the Gramian alone tells the length of `nash` to about 1e-3.
                assert length <= factor * (1 + 1e-3) * longest


@pytest.mark.parametrize("dtype", TYPES)
@pytest.mark.parametrize("name", OURS)
def test_a_block_without_views_among_ill_conditioned_blocks_is_handled(name, dtype):
    rows = np.zeros((3, 4, 1))
    rows[1:, :, 0] = [[1, -1, 1, 0], [1, 2, 3, -4]]
    found = results(made(name), Batch(rows, dtype, "test"))
    assert np.isfinite(found).all()
    assert not found[0].any()

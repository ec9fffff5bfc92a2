"""MGDA, CAGrad, UPGrad and DualProj on short rows, where Gramians are singular."""

import mpmath
import numpy as np
import pytest
import torch

from crossgrad_operators.stress.cases import short
from crossgrad_operators.stress.runner import run_case
from crossgrad_operators.stress.suite import made, reference_of
from crossgrad_operators.stress.verdict import ExactCase

METHODS = ("mgda", "cagrad", "upgrad", "dualproj")
#: CAGrad was 7 % off here.
FIVE = [[-9, 8], [-4, 2], [1, 4], [9, 7], [-9, -2]]


def verdict(name, rows, dtype=torch.float32):
    operator = made(name)
    with mpmath.mp.workdps(50):
        exact = ExactCase(short("short", np.array(rows, dtype=float), dtype))
        return run_case(name, operator, exact, reference_of(name, operator)).finding


@pytest.mark.parametrize("name", METHODS)
def test_five_short_gradients_give_exact_results(name):
    assert verdict(name, FIVE).verdict == "ok"


@pytest.mark.parametrize("name", METHODS)
def test_integer_gradients_give_exact_results(name):
    rng = np.random.default_rng(3)
    for _ in range(12):
        views, size = rng.integers(3, 10), rng.integers(1, 5)
        rows = rng.integers(-9, 10, (views, size))
        finding = verdict(name, rows)
        assert finding.verdict in {"ok", "undetermined", "outside"}, (rows, finding)


def test_upgrad_of_nearly_opposite_gradients_does_not_jump_to_zero(ask):
    """A part of a third gradient conflicts with neither of two almost opposite gradients."""
    lengths = []
    for distance in (1e-4, 1e-5, 3e-6):
        rows = [[1.0, 0.0, 0.0], [-1.0, distance, 0.0], [0.3, -0.9, 0.3]]
        lengths.append(np.linalg.norm(ask("upgrad", rows).result))
    np.testing.assert_allclose(lengths, 0.1, rtol=1e-2)


@pytest.mark.parametrize("name", METHODS)
def test_weights_of_short_gradients_are_finite(name, ask):
    rng = np.random.default_rng(0)
    for _ in range(500):
        rows = rng.standard_normal((rng.integers(2, 21), rng.integers(1, 6)))
        found = ask(name, rows)
        assert np.isfinite(found.weights).all()
        assert np.linalg.norm(found.result) <= 1.6 * np.linalg.norm(rows, axis=1).max()


#: Almost, and exactly, opposite gradients among others, in few elements.
NEARLY = [
    [[1.0, 0.0, 0.0], [-1.0, 1e-6, 0.0], [0.3, -0.9, 0.3], [0.1, 0.2, -1.0]],
    [[2.0, 1.0], [-2.0, -1.0], [1.0, 3.0], [1.0, -4.0]],
    [[1.0, 1e-5], [-1.0, 1e-5], [0.5, -1.0], [0.0, 0.0]],
]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("name", METHODS)
def test_nearly_cancelling_gradients_give_no_wrong_result(name, dtype):
    for rows in NEARLY:
        assert verdict(name, rows, dtype).verdict in {"ok", "undetermined", "outside"}, rows


def test_cagrad_gives_zero_if_two_short_gradients_cancel(ask):
    """Two short gradients cancel, so no direction has a positive product with all gradients."""
    rows = np.array([[0.5, 1, 2], [0.2, 4, 1], [0.3, 2, 5], [1e-3, 0, 0], [-1e-3, 0, 0]])
    assert not ask("cagrad", rows).result.any()

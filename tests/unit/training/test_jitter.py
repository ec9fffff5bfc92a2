"""How much a curve jumps around its trend, as benchmarks/steady_ends.py tells it."""

import runpy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

SCRIPT = Path(__file__).parents[3] / "benchmarks" / "steady_ends.py"


@pytest.fixture(scope="module")
def script():
    return SimpleNamespace(**runpy.run_path(str(SCRIPT)))


@pytest.mark.parametrize("slope", [0.0, 0.01, -3.0])
def test_a_trend_does_not_count_as_jitter(script, slope):
    steps = np.arange(1900, 2001, 5)
    assert script.jitter(steps, 20 + slope * steps) == pytest.approx(0.0, abs=1e-9)
    noise = np.random.default_rng(0).normal(0.0, 0.3, 2000)
    many = np.arange(2000)
    assert script.jitter(many, slope * many + noise) == pytest.approx(0.3, rel=0.05)


def test_the_jitter_of_few_values_is_unbiased(script):
    rng = np.random.default_rng(1)
    squares = [script.jitter(range(20), rng.normal(0, 1, 20)) ** 2 for _ in range(2000)]
    assert np.mean(squares) == pytest.approx(1.0, rel=0.05)


def test_the_jitter_uses_only_the_last_tenth_of_a_curve(script):
    rows = tuple({"step": k, "psnr": float(k)} for k in range(10, 401, 10))
    run = SimpleNamespace(rows=(*rows, {"step": 400, "psnr": None}))
    assert script.last_tenth(run) == ([370, 380, 390, 400], [370, 380, 390, 400])

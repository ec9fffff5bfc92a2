"""Bounds that let the kernels of the analytic response skip pixels never skip a touched one."""

import numba
import numpy as np
import pytest

from crossgrad_plugins.rasterizers.numba_kernels.tiles import analytic
from crossgrad_plugins.rasterizers.numba_kernels.tiles.analytic import CUBIC, LINEAR, TAIL


# Device functions have no entry point for Python.
@numba.njit
def window(offset, sigma):
    return analytic.window(offset, sigma)


@numba.njit
def central_window(sigma):
    return analytic.central_window(sigma)


@numba.njit
def squared_radius(opacity):
    return analytic.squared_radius(opacity)


def test_the_approximate_normal_density_decreases_at_least_as_fast_as_its_bound():
    x = np.linspace(-60.0, 60.0, 1_000_001)
    cubic = LINEAR * x + CUBIC * x**3
    slope = np.log(LINEAR + 3 * CUBIC * x**2)
    log_density = slope - np.abs(cubic) - 2 * np.log1p(np.exp(-np.abs(cubic)))
    assert (log_density <= np.log(LINEAR / 4) - TAIL * x**2 / 2 + 1e-12).all()


@pytest.mark.parametrize("sigma", [1e-3, 0.05, 0.3, 1.0, 7.0, 1e4])
def test_the_window_is_the_difference_of_the_distribution_function_across_a_pixel(sigma):
    def distribution(x):
        return 1 / (1 + np.exp(-np.clip(LINEAR * x + CUBIC * x**3, -700, 700)))

    for offset in (0.0, 0.3 * sigma, 0.5, 1.7 * sigma + 0.4):
        sides = (abs(offset) + 0.5) / sigma, (abs(offset) - 0.5) / sigma
        wanted = np.sqrt(2 * np.pi) * sigma * (distribution(sides[0]) - distribution(sides[1]))
        assert window(offset, sigma) == pytest.approx(wanted, rel=1e-6, abs=1e-14)
    assert central_window(sigma) == pytest.approx(window(0.0, sigma), rel=1e-12)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("opacity", [0.004, 0.02, 0.3, 1.0])
def test_pixels_touched_by_a_gaussian_are_within_its_radius(opacity):
    rng = np.random.default_rng(0)
    sigmas = np.exp(rng.uniform(np.log(1e-3), np.log(50), (40_000, 2)))
    offsets = rng.uniform(0, 1, (40_000, 2)) * (4 * sigmas + 1)
    squared = squared_radius(opacity)
    nearest_miss = 0.0
    for sigma, offset in zip(sigmas, offsets, strict=True):
        beyond = np.maximum(np.abs(offset) - 0.5, 0) / sigma
        alpha = opacity * window(offset[0], sigma[0]) * window(offset[1], sigma[1])
        if alpha >= 1 / 255:
            assert (beyond**2).sum() <= squared
            nearest_miss = max(nearest_miss, (beyond**2).sum())
    assert opacity == 0.004 or nearest_miss > 0.5 * squared

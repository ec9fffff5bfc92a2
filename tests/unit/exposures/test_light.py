"""Gains in linear light and affine maps: the kernels against plain torch in float64."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from crossgrad_plugins.exposures import srgb
from crossgrad_plugins.exposures.light import mapped, with_gain

STOPS = st.floats(-10, 10, width=32)
SIZES = st.tuples(st.integers(1, 9), st.integers(1, 9))
SEEDS = st.integers(0, 2**16)


def image(size, seed, low=-0.5, high=2.0):
    """Half of the values are dark, some lie outside [0, 1]."""
    rng = np.random.default_rng(seed)
    values = rng.uniform(low, high, (*size, 3))
    dark = rng.uniform(-0.01, 0.09, values.shape)
    return torch.from_numpy(np.where(rng.random(values.shape) < 0.5, dark, values)).float()


def both(function, *inputs):
    """Result and gradients by all inputs, in float32 and in float64."""
    found = []
    for kind in (torch.float32, torch.float64):
        given_ = [each.to(kind).requires_grad_() for each in inputs]
        taken = function(*given_)
        upstream = torch.linspace(-1, 2, taken.numel(), dtype=kind).view_as(taken)
        gradients = torch.autograd.grad(taken, given_, upstream)
        found.append([each.detach().double() for each in (taken, *gradients)])
    return zip(*found, strict=True)


def check(pairs):
    for compiled, exact in pairs:
        # Gradients are sums of terms that may cancel: float32 knows 6e-8 of these.
        scale = float(exact.abs().max()) + 1e-1
        assert float((compiled - exact).abs().max()) < 3e-6 * scale


@settings(max_examples=60, deadline=None)
@given(SIZES, SEEDS, STOPS)
def test_one_gain_is_that_of_the_curve_of_srgb(size, seed, stops):
    check(both(with_gain, image(size, seed), torch.tensor(stops)))


@settings(max_examples=60, deadline=None)
@given(SIZES, SEEDS, st.tuples(STOPS, STOPS, STOPS))
def test_each_channel_has_a_gain_of_its_own(size, seed, stops):
    check(both(with_gain, image(size, seed), torch.tensor(stops)))


@settings(max_examples=40, deadline=None)
@given(SIZES, SEEDS)
def test_an_affine_map_is_a_product(size, seed):
    matrix = torch.randn(3, 4, generator=torch.Generator().manual_seed(seed))
    check(both(mapped, image(size, seed), matrix))


def test_long_sums_stay_exact():
    pairs = both(with_gain, image((160, 240), 3, 0.0, 1.0), torch.tensor([0.5, -0.5, 2.0]))
    check(pairs)
    check(both(mapped, image((160, 240), 3, 0.0, 1.0), torch.eye(3, 4)))


@pytest.mark.parametrize("stops", [-10.0, -1.0, 0.0, 1.0, 10.0])
def test_the_reference_is_differentiable_wherever_it_is_smooth(stops):
    values = image((4, 5), 1).double()
    light = srgb.decoded(values)
    # Away from the two corners of the curve.
    smooth = ((values - srgb.THRESHOLD).abs() > 1e-3) & (
        (light * 2.0**stops - srgb.THRESHOLD_LINEAR).abs() > 1e-4 * 2.0**stops
    )
    values = torch.where(smooth, values, torch.full_like(values, 0.5))
    inputs = (values.requires_grad_(), torch.tensor(stops).double().requires_grad_())
    assert torch.autograd.gradcheck(srgb.with_gain, inputs, eps=1e-7, rtol=1e-3)


def test_the_curve_and_its_inverse():
    values = torch.linspace(-1, 3, 401, dtype=torch.float64)
    assert torch.allclose(srgb.encoded(srgb.decoded(values)), values, atol=1e-6)
    # IEC 61966-2-1: 18 % grey, and the ends.
    grey = srgb.encoded(torch.tensor([0.0, 0.18, 1.0], dtype=torch.float64))
    assert torch.allclose(grey, torch.tensor([0.0, 0.46136, 1.0], dtype=torch.float64), atol=1e-5)


def test_a_nan_stays_visible():
    values = image((3, 9), 2)
    values[1, 4, 2] = float("nan")
    taken = with_gain(values, torch.tensor(1.0))
    assert torch.equal(taken.isnan(), values.isnan())


def test_a_view_that_is_not_contiguous_is_taken_as_it_is():
    values = image((6, 8), 4)
    turned = values.transpose(0, 1)
    expected = with_gain(turned.contiguous(), torch.tensor(0.7))
    assert torch.equal(with_gain(turned, torch.tensor(0.7)), expected)
    assert torch.equal(mapped(turned, torch.eye(3, 4)), turned)

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


#: One rounding of float32.
ROUNDING = 2.0**-24
#: Roundings of a value through both curves, worst near black: 40. A sum over pixels has 32 more,
#: after which it goes on in float64, but no offset is subtracted from its terms: 57.
OF_GAINS = 64
#: Those of a product of four terms, and of a sum over 256 pixels.
OF_A_MAP, OF_ITS_SUMS = 5, 260


def away_from_corners(image, stops):
    """The image, black where rounding may decide on which side of a corner of a curve a value is.

    The slope has a jump there.
    """
    light = srgb.decoded(image.double()) * torch.exp2(stops.double())
    near = (image / srgb.THRESHOLD - 1).abs().minimum((light / srgb.THRESHOLD_LINEAR - 1).abs())
    return torch.where(near < 1e-5, 0.0, image)


def outcome(function, inputs, upstream, kind):
    """Result and gradients by all inputs, computed in numbers of a kind, in float64."""
    leaves = [each.to(kind).requires_grad_() for each in inputs]
    taken = function(*leaves)
    gradients = torch.autograd.grad(taken, leaves, upstream.to(kind).view_as(taken))
    return [each.detach().double() for each in (taken, *gradients)]


def check(function, inputs, sizes, roundings):
    """Each number is within so many roundings of the sum of its terms' sizes."""
    upstream = torch.linspace(-1, 2, inputs[0].numel())
    compiled, exact = (outcome(function, inputs, upstream, k)
                       for k in (torch.float32, torch.float64))  # fmt: skip
    limits = sizes(exact, upstream)
    for one, other, size, count in zip(compiled, exact, limits, roundings, strict=True):
        assert bool(((one - other).abs() <= count * ROUNDING * size).all())


def check_gain(image, stops):
    image = away_from_corners(image, stops)

    def sizes(exact, upstream):
        # A value grows with the stops where it is positive.
        alike = upstream.abs() * image.sign().view(-1)
        of_stops = outcome(with_gain, (image, stops), alike, torch.float64)[2]
        return exact[0].abs(), exact[1].abs(), of_stops

    check(with_gain, (image, stops), sizes, (OF_GAINS,) * 3)


def check_map(image, matrix):
    def sizes(exact, upstream):
        return outcome(mapped, (image.abs(), matrix.abs()), upstream.abs(), torch.float64)

    check(mapped, (image, matrix), sizes, (OF_A_MAP, OF_A_MAP, OF_ITS_SUMS))


@settings(max_examples=60, deadline=None)
@given(SIZES, SEEDS, STOPS)
def test_a_gain_agrees_with_the_srgb_curve(size, seed, stops):
    check_gain(image(size, seed), torch.tensor(stops))


@settings(max_examples=60, deadline=None)
@given(SIZES, SEEDS, st.tuples(STOPS, STOPS, STOPS))
def test_each_channel_has_a_separate_gain(size, seed, stops):
    check_gain(image(size, seed), torch.tensor(stops))


@settings(max_examples=40, deadline=None)
@given(SIZES, SEEDS)
def test_an_affine_map_is_a_matrix_product(size, seed):
    matrix = torch.randn(3, 4, generator=torch.Generator().manual_seed(seed))
    check_map(image(size, seed), matrix)


def test_long_sums_in_the_exposure_gradient_are_exact():
    check_gain(image((160, 240), 3, 0.0, 1.0), torch.tensor([0.5, -0.5, 2.0]))
    check_map(image((160, 240), 3, 0.0, 1.0), torch.eye(3, 4))


@pytest.mark.parametrize("stops", [-10.0, -1.0, 0.0, 1.0, 10.0])
def test_the_reference_is_differentiable_except_at_its_corners(stops):
    values = image((4, 5), 1).double()
    light = srgb.decoded(values)
    # Away from the two corners of the curve.
    smooth = ((values - srgb.THRESHOLD).abs() > 1e-3) & (
        (light * 2.0**stops - srgb.THRESHOLD_LINEAR).abs() > 1e-4 * 2.0**stops
    )
    values = torch.where(smooth, values, torch.full_like(values, 0.5))
    inputs = (values.requires_grad_(), torch.tensor(stops).double().requires_grad_())
    assert torch.autograd.gradcheck(srgb.with_gain, inputs, eps=1e-7, rtol=1e-3)


def test_decoding_to_linear_light_inverts_the_srgb_curve_and_has_known_values():
    values = torch.linspace(-1, 3, 401, dtype=torch.float64)
    assert torch.allclose(srgb.encoded(srgb.decoded(values)), values, atol=1e-6)
    # IEC 61966-2-1: 18 % grey, and the ends.
    grey = srgb.encoded(torch.tensor([0.0, 0.18, 1.0], dtype=torch.float64))
    assert torch.allclose(grey, torch.tensor([0.0, 0.46136, 1.0], dtype=torch.float64), atol=1e-5)


def test_nan_values_are_kept():
    values = image((3, 9), 2)
    values[1, 4, 2] = float("nan")
    taken = with_gain(values, torch.tensor(1.0))
    assert torch.equal(taken.isnan(), values.isnan())


def test_an_image_that_is_not_contiguous_gives_the_same_result():
    values = image((6, 8), 4)
    turned = values.transpose(0, 1)
    expected = with_gain(turned.contiguous(), torch.tensor(0.7))
    assert torch.equal(with_gain(turned, torch.tensor(0.7)), expected)
    assert torch.equal(mapped(turned, torch.eye(3, 4)), turned)

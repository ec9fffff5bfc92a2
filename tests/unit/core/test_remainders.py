"""Gramians with the digits that rounding to float64 took from them."""

from fractions import Fraction

import numpy as np
import pytest
import torch

from crossgrad_core.contract.blocks import Block, LearningRate
from crossgrad_core.gradients.separate import DenseGradients
from crossgrad_core.numerics import double_double
from crossgrad_core.numerics.jit import strict_kernel

RATE = LearningRate(1.0)
BLOCKS = (
    Block("means", ("means",), True, "geometry", RATE),
    Block("scales", ("scales",), True, "geometry", RATE),
    Block("mlp", ("mlp.0", "mlp.1"), False, "neutral", RATE),
)
SHAPES = {"means": (6, 3), "scales": (6, 2), "mlp.0": (7, 5), "mlp.1": (5,)}
GROUPS = {
    "block": [["means"], ["scales"], ["mlp.0", "mlp.1"]],
    "kind": [["means", "scales"], ["mlp.0", "mlp.1"]],
    "global": [list(SHAPES)],
}


def views_of(count, dtype, seed=0, scale=1.0):
    """Gradients of which some sums of products cancel."""
    generator = torch.Generator().manual_seed(seed)
    views = []
    for _ in range(count):
        view = {}
        for name, shape in SHAPES.items():
            wide = torch.randn(shape, generator=generator, dtype=torch.float64)
            view[name] = (wide * scale * 10.0 ** (4 * wide)).to(dtype)
        views.append(view)
    return views


def exact_product(one, other, names, rows=slice(None)):
    total = Fraction(0)
    for name in names:
        a, b = (v[name][rows].double().flatten().tolist() for v in (one, other))
        total += sum(Fraction(x) * Fraction(y) for x, y in zip(a, b, strict=True))
    return total


def check(gradients, granularity, block, views, names, rows=slice(None)):
    gramian = gradients.gramians(granularity)[block]
    rest = gradients.rounding_residuals(granularity)[block]
    for i, one in enumerate(views):
        for j, other in enumerate(views):
            exact = exact_product(one, other, names, rows)
            found = Fraction(gramian[i, j]) + Fraction(rest[i, j])
            assert abs(found - exact) <= 1e-29 * gramian[i, i] ** 0.5 * gramian[j, j] ** 0.5
            assert abs(rest[i, j]) <= 1e-13 * gramian[i, i] ** 0.5 * gramian[j, j] ** 0.5


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
@pytest.mark.parametrize("granularity", GROUPS)
def test_gramian_and_rounding_residual_have_twice_the_digits(granularity, dtype):
    views = views_of(3, dtype)
    gradients = DenseGradients(views, BLOCKS)
    for block, names in enumerate(GROUPS[granularity]):
        check(gradients, granularity, block, views, names)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gramians_of_single_primitives_have_twice_the_digits(dtype):
    views = views_of(4, dtype, seed=1)
    gradients = DenseGradients(views, BLOCKS)
    for row in range(6):
        check(gradients, "gaussian", row, views, ["means"], row)
        check(gradients, "gaussian", 6 + row, views, ["scales"], row)
    check(gradients, "gaussian", 12, views, ["mlp.0", "mlp.1"])


def test_gradients_whose_squares_overflow_float64_keep_their_digits():
    views = views_of(2, torch.float64, scale=1e160)
    gradients = DenseGradients(views, BLOCKS)
    gramian, rest = gradients.gramians("global")[0], gradients.rounding_residuals("global")[0]
    found = [Fraction(gramian[i, 1]) + Fraction(rest[i, 1]) for i in range(2)]
    exact = [exact_product(views[i], views[1], list(SHAPES)) for i in range(2)]
    assert abs(found[0] / found[1] - exact[0] / exact[1]) <= 1e-29


def test_views_that_are_left_out_have_zero_rounding_residuals():
    views = views_of(3, torch.float32)
    views[1]["means"][2, 1] = torch.inf
    views[2] = {"scales": views[2]["scales"], "mlp.0": None}
    gradients = DenseGradients(views, BLOCKS)
    rest = gradients.rounding_residuals("block")
    assert np.isfinite(rest).all()
    assert not rest[0, 1].any() and not rest[0, :, 1].any()
    assert not rest[0, 2].any() and not rest[2, 2].any()
    assert rest[1].any()


def test_the_rounding_unit_comes_from_the_least_precise_gradient_type():
    def unit(*types):
        views = [{"means": torch.ones(2, 3, dtype=kind)} for kind in types]
        return DenseGradients(views, BLOCKS).unit

    assert unit(torch.float32, torch.float32) == 2.0**-24
    assert unit(torch.float64) == 2.0**-53
    assert unit(torch.bfloat16) == 2.0**-8
    assert DenseGradients([{}], BLOCKS).unit == 2.0**-24


@strict_kernel
def operated(a, a_low, b, b_low):
    """Sum, product, quotient, and root of the first."""
    return (
        double_double.add(a, a_low, b, b_low),
        double_double.multiply(a, a_low, b, b_low),
        double_double.divide(a, a_low, b, b_low),
        double_double.square_root(a, a_low),
    )


def test_double_double_arithmetic_agrees_with_exact_fractions():
    rng = np.random.default_rng(2)
    tolerance = Fraction(2) ** -100
    for _ in range(300):
        a, b = rng.standard_normal(2) * 10.0 ** rng.uniform(-20, 20, 2)
        a = abs(a)
        pairs = [(x, x * rng.uniform(-1, 1) * 2.0**-53) for x in (a, b)]
        one, other = (Fraction(high) + Fraction(low) for high, low in pairs)
        found = operated(*pairs[0], *pairs[1])
        total, product, quotient, root = (Fraction(high) + Fraction(low) for high, low in found)
        assert all(high == high + low for high, low in found)
        assert abs(total - (one + other)) <= tolerance * abs(one + other)
        assert abs(product / (one * other) - 1) <= tolerance
        assert abs(quotient * other / one - 1) <= tolerance
        assert abs(root * root / one - 1) <= tolerance
    assert operated(0.0, 0.0, 1.0, 0.0)[3] == (0.0, 0.0)

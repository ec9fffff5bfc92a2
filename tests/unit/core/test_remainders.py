"""Gramians with the digits that rounding to float64 took from them."""

from fractions import Fraction

import numpy as np
import pytest
import torch

from crossgrad_core.contract.blocks import Block, LearningRate
from crossgrad_core.gradients.separate import DenseGradients
from crossgrad_core.numerics import double_double

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
    rest = gradients.remainders(granularity)[block]
    for i, one in enumerate(views):
        for j, other in enumerate(views):
            exact = exact_product(one, other, names, rows)
            found = Fraction(gramian[i, j]) + Fraction(rest[i, j])
            assert abs(found - exact) <= 1e-29 * gramian[i, i] ** 0.5 * gramian[j, j] ** 0.5
            assert abs(rest[i, j]) <= 1e-13 * gramian[i, i] ** 0.5 * gramian[j, j] ** 0.5


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
@pytest.mark.parametrize("granularity", GROUPS)
def test_gramian_and_remainder_have_twice_the_digits(granularity, dtype):
    views = views_of(3, dtype)
    gradients = DenseGradients(views, BLOCKS)
    for block, names in enumerate(GROUPS[granularity]):
        check(gradients, granularity, block, views, names)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_so_have_those_of_single_primitives(dtype):
    views = views_of(4, dtype, seed=1)
    gradients = DenseGradients(views, BLOCKS)
    for row in range(6):
        check(gradients, "gaussian", row, views, ["means"], row)
        check(gradients, "gaussian", 6 + row, views, ["scales"], row)
    check(gradients, "gaussian", 12, views, ["mlp.0", "mlp.1"])


def test_gradients_whose_squares_leave_float64_keep_their_digits():
    views = views_of(2, torch.float64, scale=1e160)
    gradients = DenseGradients(views, BLOCKS)
    gramian, rest = gradients.gramians("global")[0], gradients.remainders("global")[0]
    found = [Fraction(gramian[i, 1]) + Fraction(rest[i, 1]) for i in range(2)]
    exact = [exact_product(views[i], views[1], list(SHAPES)) for i in range(2)]
    assert abs(found[0] / found[1] - exact[0] / exact[1]) <= 1e-29


def test_views_that_do_not_count_have_none():
    views = views_of(3, torch.float32)
    views[1]["means"][2, 1] = torch.inf
    views[2] = {"scales": views[2]["scales"], "mlp.0": None}
    gradients = DenseGradients(views, BLOCKS)
    rest = gradients.remainders("block")
    assert np.isfinite(rest).all()
    assert not rest[0, 1].any() and not rest[0, :, 1].any()
    assert not rest[0, 2].any() and not rest[2, 2].any()
    assert rest[1].any()


def test_the_unit_is_that_of_the_narrowest_rounding():
    def unit(*types):
        views = [{"means": torch.ones(2, 3, dtype=kind)} for kind in types]
        return DenseGradients(views, BLOCKS).unit

    assert unit(torch.float32, torch.float32) == 2.0**-24
    assert unit(torch.float64) == 2.0**-53
    assert unit(torch.bfloat16) == 2.0**-8
    assert DenseGradients([{}], BLOCKS).unit == 2.0**-24


@pytest.mark.parametrize(
    ("name", "operation"),
    [
        ("add", lambda a, b: a + b),
        ("multiply", lambda a, b: a * b),
        ("divide", lambda a, b: a / b),
    ],
)
def test_double_double_arithmetic(name, operation):
    rng = np.random.default_rng(2)
    compiled = getattr(double_double, name)
    for _ in range(300):
        a, b = rng.standard_normal(2) * 10.0 ** rng.uniform(-20, 20, 2)
        numbers = (a, a * rng.uniform(-1, 1) * 2.0**-53, b, b * rng.uniform(-1, 1) * 2.0**-53)
        exact = operation(*(Fraction(h) + Fraction(low) for h, low in (numbers[:2], numbers[2:])))
        high, low = compiled(*numbers)
        assert high == high + low
        assert abs(Fraction(high) + Fraction(low) - exact) <= abs(exact) * Fraction(2) ** -100


def test_double_double_roots():
    rng = np.random.default_rng(3)
    for _ in range(300):
        a = 10.0 ** rng.uniform(-20, 20)
        low = a * rng.uniform(-1, 1) * 2.0**-53
        high, rest = double_double.square_root(a, low)
        exact = Fraction(a) + Fraction(low)
        assert abs((Fraction(high) + Fraction(rest)) ** 2 - exact) <= exact * Fraction(2) ** -100
    assert double_double.square_root(0.0, 0.0) == (0.0, 0.0)

"""GradDrop: one sign per element, the sum on average."""

import numpy as np
import pytest
import torch

from crossgrad_core.contract.blocks import EMPTY_STATE
from crossgrad_operators.graddrop import GradDrop
from crossgrad_operators.stress.reference import Views
from crossgrad_operators.stress.runner import BLOCK, context_of


def drop(*gradients, seed=0):
    views = Views(("near",) * len(gradients), (1.0,) * len(gradients), seed)
    context = context_of([{"means": g} for g in gradients], (BLOCK,), views)
    return GradDrop().aggregate(context, EMPTY_STATE)[0].gradients["means"]


def test_graddrop_keeps_the_positive_sign_with_probability_two_thirds_for_two_to_one():
    count = 90_000
    found = drop(torch.full((count,), 2.0), torch.full((count,), -1.0))
    assert set(found.unique().tolist()) == {-1.0, 2.0}
    share = float((found > 0).float().mean())
    assert abs(share - 2 / 3) < 4 * np.sqrt(2 / 9 / count)


def test_graddrop_adds_elements_of_equal_sign_and_keeps_zeros():
    found = drop(torch.tensor([1.0, -2.0, 0.0, 0.0]), torch.tensor([3.0, -1.0, 5.0, 0.0]))
    assert found.tolist() == [4.0, -3.0, 5.0, 0.0]


@pytest.mark.parametrize("size", [3e38, 1e-45])
def test_extreme_gradient_elements_neither_overflow_nor_vanish_in_graddrop(size):
    found = drop(torch.full((1000,), size), torch.full((1000,), -size))
    assert set(found.abs().unique().tolist()) == {float(np.float32(size))}
    assert 400 < int((found > 0).sum()) < 600


def test_graddrop_with_the_same_generator_keeps_the_same_signs():
    g = torch.randn((2, 500), generator=torch.Generator().manual_seed(0))
    assert torch.equal(drop(*g), drop(*g))
    assert not torch.equal(drop(*g), drop(*g, seed=1))


def test_non_finite_views_are_left_out():
    bad = torch.tensor([1.0, float("nan")])
    assert drop(bad, torch.tensor([2.0, -3.0])).tolist() == [2.0, -3.0]
    assert drop(bad, bad) is None

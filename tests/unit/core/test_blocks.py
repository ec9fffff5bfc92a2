"""Blocks and rates that nothing could train are refused where they are made."""

import pytest

from crossgrad_core.contract.blocks import Block, LearningRate


@pytest.mark.parametrize("rates", [(-1e-3,), (1e-3, -1.0), (float("nan"),), (float("inf"),)])
def test_learning_rates_must_be_finite_and_not_negative(rates):
    with pytest.raises(ValueError, match="finite and not negative"):
        LearningRate(*rates)


@pytest.mark.parametrize("factor", [0.0, -2.0, float("nan"), float("inf")])
def test_the_learning_rate_factor_for_few_passes_must_be_positive(factor):
    with pytest.raises(ValueError, match="`few_passes` must be a positive number"):
        LearningRate(1e-3, few_passes=factor)


def test_a_learning_rate_cannot_decay_to_zero():
    with pytest.raises(ValueError, match="cannot decay log-linearly to 0"):
        LearningRate(1e-3, 0.0)
    assert LearningRate(0.0, 0.0).at(0.5) == 0.0
    assert LearningRate(1e-2, 1e-4).at(0.5) == pytest.approx(1e-3)


def test_a_block_requires_a_known_kind_names_and_a_learning_rate():
    rate = LearningRate(1e-3)
    assert not Block("means", ("means",), True, "geometry", rate).frozen
    with pytest.raises(ValueError, match="found 'colour'"):
        Block("means", ("means",), True, "colour", rate)
    with pytest.raises(TypeError, match="a tuple of names"):
        Block("means", "means", True, "geometry", rate)
    with pytest.raises(TypeError, match="`lr` a LearningRate"):
        Block("means", ("means",), True, "geometry", 1e-3)

"""Blocks and rates that nothing could train are refused where they are made."""

import pytest

from crossgrad_core.contract.blocks import Block, LearningRate


@pytest.mark.parametrize("rates", [(-1e-3,), (1e-3, -1.0), (float("nan"),), (float("inf"),)])
def test_rates_are_finite_and_not_negative(rates):
    with pytest.raises(ValueError, match="finite and not negative"):
        LearningRate(*rates)


@pytest.mark.parametrize("factor", [0.0, -2.0, float("nan"), float("inf")])
def test_a_rate_of_few_passes_is_a_positive_part_of_itself(factor):
    with pytest.raises(ValueError, match="`few_passes` must be a positive number"):
        LearningRate(1e-3, few_passes=factor)


def test_no_rate_fades_to_nothing():
    with pytest.raises(ValueError, match="cannot decay log-linearly to 0"):
        LearningRate(1e-3, 0.0)
    assert LearningRate(0.0, 0.0).at(0.5) == 0.0
    assert LearningRate(1e-2, 1e-4).at(0.5) == pytest.approx(1e-3)


def test_a_block_has_a_known_kind_names_and_a_rate():
    rate = LearningRate(1e-3)
    assert not Block("means", ("means",), True, "geometry", rate).frozen
    with pytest.raises(ValueError, match="found 'colour'"):
        Block("means", ("means",), True, "colour", rate)
    with pytest.raises(TypeError, match="a tuple of names"):
        Block("means", "means", True, "geometry", rate)
    with pytest.raises(TypeError, match="`lr` a LearningRate"):
        Block("means", ("means",), True, "geometry", 1e-3)

"""Tests of the wrapper's effect on the operator's result."""

import pytest
import torch
from crossgrad_example.clip import STATE, Clip
from crossgrad_example.equal_length import EqualLength

from crossgrad_core.contract.contexts import AggregateResult
from crossgrad_core.registry.manager import call_first_result, make_manager
from crossgrad_core.testing.support.aggregation import aggregate_context, sample_gradients


def answered(max_norm: float) -> AggregateResult:
    plugins = {"operator": EqualLength(), "clip": Clip(max_norm=max_norm)}
    hook = make_manager(plugins).hook.crossgrad_aggregate_gradients
    return call_first_result(hook, aggregate_context(sample_gradients(2)), AggregateResult)


def test_long_gradients_are_shortened_and_counted() -> None:
    answer = answered(0.25)
    means, weight = answer.gradients["means"], answer.gradients["net.weight"]
    bias = answer.gradients["net.bias"]
    assert means is not None
    assert weight is not None
    assert bias is not None
    assert float(means.norm()) == pytest.approx(0.25)
    assert float(torch.hypot(weight.norm(), bias.norm())) == pytest.approx(0.25)
    assert answer.counts["clipped"] == len(("means", "f_dc", "net"))
    assert answer.states[STATE].values == {"clipped": 3}


def test_short_gradients_keep_their_bits() -> None:
    hook = make_manager({"operator": EqualLength()}).hook.crossgrad_aggregate_gradients
    expected = call_first_result(
        hook, aggregate_context(sample_gradients(2)), AggregateResult
    ).gradients["means"]
    clipped = answered(1e9).gradients["means"]
    assert expected is not None
    assert clipped is not None
    assert torch.equal(clipped, expected)

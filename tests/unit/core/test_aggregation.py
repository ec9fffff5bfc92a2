"""Counts of an aggregation whose sums overwrite the gradients."""

import numpy as np
import torch

from crossgrad_core.contract.blocks import Block, LearningRate, PluginState
from crossgrad_core.contract.contexts import AggregateContext
from crossgrad_core.contract.gramian_operator import aggregate_by_gramians
from crossgrad_core.gradients.separate import DenseGradients
from crossgrad_core.testing.fixtures import step_fields
from crossgrad_operators.projection import PCGrad

BLOCKS = tuple(
    Block(name, (name,), per_primitive=True, kind="geometry", lr=LearningRate(0.1))
    for name in ("apart", "crossed", "opposed")
)


def test_gradients_without_a_common_nonzero_element_are_counted_and_added():
    one = {
        "apart": torch.tensor([1.0, 0.0]),
        "crossed": torch.tensor([1.0, 1.0]),
        "opposed": torch.tensor([1.0, 0.0]),
    }
    other = {
        "apart": torch.tensor([0.0, 2.0]),
        "crossed": torch.tensor([1.0, -1.0]),
        "opposed": torch.tensor([-1.0, 0.5]),
    }
    sums = {name: one[name] + other[name] for name in ("apart", "crossed")}
    context = AggregateContext(
        **step_fields(),
        gradients=DenseGradients([one, other], BLOCKS, overwrite=True),
        losses=np.ones(2),
        labels=None,
        distances=np.ones(2),
        reference_distance=1.0,
        blocks=BLOCKS,
    )
    aggregated, _ = aggregate_by_gramians(PCGrad(), "block", context, PluginState())
    assert dict(aggregated.counts) == {"zero": 0, "disjoint": 1, "dropped": 0, "conflict": 1}
    for name, wanted in sums.items():
        assert torch.equal(aggregated.gradients[name], wanted)

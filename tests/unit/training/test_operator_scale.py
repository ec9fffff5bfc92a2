"""What regularisers and the optimizer follow: c(K), the weight of K equal gradients."""

from dataclasses import replace
from math import nan, sqrt
from typing import ClassVar

import numpy as np
import pytest
import torch

from crossgrad_core.contract.component import ViewCounts
from crossgrad_core.contract.contexts import AggregateResult
from crossgrad_core.contract.gramian_operator import GramianOperator
from crossgrad_core.contract.slots.operator import Operator
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import build, entries
from crossgrad_core.testing.support.aggregation import aggregate_context, sample_gradients
from crossgrad_core.testing.support.contract import admitted
from crossgrad_core.training.setup import OperatorScale, Scale, neutral
from crossgrad_core.training.views import joined

TENSORS = ("means", "f_dc", "net.weight", "net.bias")
#: methods.md 8 and 11.11.
EXPECTED = {
    "sum": lambda k: k,
    "mean": lambda k: 1,
    "upgrad": lambda k: 1,
    "dualproj": lambda k: 1,
    "gradnorm": lambda k: k,
    "preconditioner": lambda k: k,
    "graddrop": lambda k: k,
    "pcgrad": lambda k: k,
    "confgate": lambda k: k,
    "mgda": lambda k: 1,
    "imtl-g": lambda k: 1,
    "nash": sqrt,
    "cagrad": lambda k: 1 if k == 1 else 1.5,
    "aligned": lambda k: 1,
}


def scale_of(operator, views):
    return OperatorScale(operator).of(aggregate_context(sample_gradients(views)))


class Fivefold(GramianOperator):
    """A third party's: the sum times five, in one row."""

    asked: ClassVar[list] = []

    def transform(self, gramians, context, state, rng):
        self.asked.append(context)
        return np.full((len(gramians), 1, gramians.shape[1]), 5.0), state


class Halves(Operator):
    """A third party's that works on elements and freezes the network."""

    def aggregate(self, context, state):
        def half(name, views):
            if name.startswith("net"):
                return None
            return sum(views[1:], views[0]) / 2

        return AggregateResult(context.gradients.elementwise(half)), state


class Broken(GramianOperator):
    def transform(self, gramians, context, state, rng):
        return np.full(gramians.shape, nan if gramians[0, 0, -1] > 0.999 else 1.0), state


class Labelled(GramianOperator):
    """Needs one view of each label."""

    views: ClassVar[ViewCounts] = ViewCounts(2, 2)

    def transform(self, gramians, context, state, rng):
        near, far = context.labels.index("near"), context.labels.index("far")
        matrix = np.zeros(gramians.shape)
        matrix[:, 0, near], matrix[:, 0, far] = 0.5, 0.75
        return matrix, state


@pytest.mark.parametrize("views", [1, 2, 3, 5])
@pytest.mark.parametrize("name", EXPECTED)
def test_bundled_operators_have_the_specified_scales(name, views):
    scale = scale_of(build("operators", name, {}), views)
    assert scale.per_step == pytest.approx(dict.fromkeys(TENSORS, EXPECTED[name](views)))
    assert scale.per_view == pytest.approx(dict.fromkeys(TENSORS, EXPECTED[name](views) / views))


@pytest.mark.parametrize("granularity", ["kind", "global", "gaussian"])
def test_every_granularity_of_an_operator_has_the_same_scale(granularity):
    operator = build("operators", "nash", {"granularity": granularity})
    assert scale_of(operator, 3).per_step == pytest.approx(dict.fromkeys(TENSORS, sqrt(3)))


@pytest.mark.parametrize("name", entries("operators"))
def test_the_scale_of_an_operator_for_a_single_view_is_exactly_one(name):
    operator = build("operators", name, {})
    if 1 in admitted(operator.views):
        scale = scale_of(operator, 1)
        ones = dict.fromkeys(TENSORS, 1.0)
        assert (scale.per_step, scale.per_view) == (ones, ones)
        assert scale.to_sum == ones


def test_the_scale_of_a_chain_is_the_product_of_its_links():
    chain = build("operators", "chain", {"links": ["symmetric", "preconditioner", "mean"]})
    assert scale_of(chain, 4).per_step == pytest.approx(dict.fromkeys(TENSORS, 1))


def test_each_block_has_the_scale_of_its_operator():
    rules = {"geometry": "mean", "appearance": "sum", "net": "nash"}
    scale = scale_of(build("operators", "dispatch", {"rules": rules}), 2)
    expected = {"means": 1, "f_dc": 2, "net.weight": sqrt(2), "net.bias": sqrt(2)}
    assert scale.per_step == pytest.approx(expected)
    assert scale.to_sum == pytest.approx({name: 2 / value for name, value in expected.items()})


def test_a_third_party_operator_is_evaluated_once_for_each_number_of_views():
    scale = OperatorScale(Fivefold())
    Fivefold.asked.clear()
    for views in (2, 3, 2, 3, 2):
        found = scale.of(aggregate_context(sample_gradients(views)))
        assert found.per_step == dict.fromkeys(TENSORS, 5.0 * views)
    assert [len(context.losses) for context in Fivefold.asked] == [2, 3]


def test_views_differ_only_by_labels_when_the_scale_of_an_operator_is_measured():
    Fivefold.asked.clear()
    context = aggregate_context(sample_gradients(3))
    OperatorScale(Fivefold()).of(replace(context, scales=(1.0, 0.5, 0.25)))
    (seen,) = Fivefold.asked
    assert seen.scales == (1.0, 1.0, 1.0)
    assert seen.present.all() and seen.step == 1
    assert len(set(seen.losses)) == 1
    assert set(seen.distances) == {seen.reference_distance}
    assert seen.labels == ("near", "far", "near")


def test_an_operator_that_needs_labels_gets_the_labels_of_the_step():
    assert scale_of(Labelled(), 2).per_step == dict.fromkeys(TENSORS, 1.25)


def test_the_scale_of_an_operator_with_its_own_aggregation_uses_this_aggregation():
    scale = scale_of(Halves(), 3)
    expected = {"means": 1.5, "f_dc": 1.5, "net.weight": 0.0, "net.bias": 0.0}
    assert scale.per_step == expected
    # What the operator freezes has no scale to follow, and no term joins.
    assert scale.to_sum == {"means": 2.0, "f_dc": 2.0, "net.weight": 1.0, "net.bias": 1.0}


def test_measuring_the_scale_of_an_operator_does_not_change_the_step():
    context = aggregate_context(sample_gradients(2))
    drawn = np.random.default_rng(0).bit_generator.state
    OperatorScale(build("operators", "graddrop", {})).of(context)
    assert context.rng.bit_generator.state == drawn
    assert context.gradients.present("block").any()
    assert neutral(context).rng is not context.rng


def test_non_finite_weights_are_refused_with_the_operator():
    with pytest.raises(UserError, match="Broken returned weights that are not finite"):
        scale_of(Broken(), 2)


class Overflowing(Operator):
    def aggregate(self, context, state):
        return AggregateResult({name: torch.tensor([torch.inf]) for name in TENSORS}), state


def test_non_finite_results_are_refused_with_operator_and_tensor():
    with pytest.raises(UserError) as caught:
        scale_of(Overflowing(), 2)
    assert "Overflowing" in str(caught.value) and "means" in str(caught.value)


def test_regularizer_terms_get_the_scale_that_the_operator_gives_equal_gradients():
    scale = Scale.of({"a": 3.0, "b": 1.5, "c": 0.0}, 3)
    one = torch.ones(2)
    of_views = {"a": 10 * one, "b": 10 * one, "c": 10 * one}
    of_step = {"b": one, "a": None, "c": one}
    result = joined({"a": one, "b": None, "c": None}, of_views, of_step, scale)
    assert torch.equal(result["a"], 11 * one)
    assert torch.equal(result["b"], (10 * 0.5 + 1.5) * one)
    assert result["c"] is None

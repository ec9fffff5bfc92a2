"""Operators made of operators: chain and dispatch."""

import json

import numpy as np
import pytest
from pydantic import ValidationError
from support.selections import selection_of

from crossgrad_core.contract.blocks import EMPTY_STATE
from crossgrad_core.contract.component import ViewCounts
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import build
from crossgrad_operators.chain import Chain
from crossgrad_operators.dispatch import Dispatch
from crossgrad_operators.projection import PCGrad

ROWS = np.array([[1.0, 0.0, 2.0], [-1.0, 1.0, -1.0], [0.5, -2.0, 0.0]])


def chain(*links):
    return build("operators", "chain", {"links": links})


def test_an_empty_chain_equals_sum(ask):
    np.testing.assert_array_equal(ask(chain(), ROWS).weights, [1, 1, 1])


@pytest.mark.parametrize("name", ["symmetric", "cagrad", "upgrad", "mgda", "preconditioner"])
def test_a_chain_of_one_operator_and_the_identity_equals_the_operator(name, ask):
    alone = ask(name, ROWS).weights
    for links in ((name,), ("sum", name), (name, "sum")):
        np.testing.assert_allclose(ask(chain(*links), ROWS).weights, alone, rtol=1e-13)


def test_chains_are_associative(ask):
    flat = ask(chain("preconditioner", "symmetric", "mean"), ROWS, distances=[0.5, 1, 2])
    left = chain(chain("preconditioner", "symmetric"), "mean")
    right = chain("preconditioner", chain("symmetric", "mean"))
    for nested in (left, right):
        found = ask(nested, ROWS, distances=[0.5, 1, 2])
        np.testing.assert_allclose(found.weights, flat.weights, rtol=1e-13)


def test_a_link_receives_the_result_of_the_previous_link(ask):
    scaled = ROWS * np.array([[0.25], [1.0], [4.0]])
    expected = ask("symmetric", scaled).result / 3
    found = ask(chain("preconditioner", "symmetric", "mean"), ROWS, distances=[0.5, 1, 2])
    np.testing.assert_allclose(found.result, expected, rtol=1e-13)


def test_gradients_that_cancel_are_zero_for_the_next_link(ask):
    rows = np.array([[2.0, 0.0], [-1.0, 0.0], [0.0, 3.0]])
    np.testing.assert_allclose(ask(chain("symmetric", "imtl-g"), rows).result, [0.0, 3.0])


def test_each_link_has_a_separate_state(ask):
    operator = chain("gradvac", "confgate", "gradvac")
    state = ask(operator, ROWS).state
    assert set(state.tensors) == {"0/target", "1/moments", "2/target"}
    assert set(ask(operator, ROWS, state=state).state.tensors) == set(state.tensors)


def test_dispatch_applies_a_separate_operator_to_each_kind(context_of):
    gramians = np.stack([ROWS[:2] @ ROWS[:2].T] * 3)
    blocks = ("means", "opacities", "f_dc")
    context = context_of(gramians, blocks=blocks)
    kinds = ("geometry", "appearance", "appearance")
    context = type(context)(**{**vars(context), "kinds": kinds})
    rng = np.random.default_rng(0)

    def weights(**options):
        operator = build("operators", "dispatch", options)
        return operator.transform(gramians, context, EMPTY_STATE, rng)[0].sum(axis=1)

    plain, projected = (
        np.ones(2),
        build("operators", "symmetric", {})
        .transform(gramians[:1], context, EMPTY_STATE, rng)[0]
        .sum(axis=1)[0],
    )
    np.testing.assert_allclose(weights(), [plain, plain, plain])
    found = weights(variant="geometry-projection")
    np.testing.assert_allclose(found, [projected, plain, plain])
    found = weights(variant="geometry-projection", opacity="geometry")
    np.testing.assert_allclose(found, [projected, projected, plain])
    found = weights(rules={"f_dc": "mean", "appearance": {"name": "cagrad", "c": 0.0}})
    np.testing.assert_allclose(found, [plain, plain / 2, plain / 2])


@pytest.mark.parametrize(
    "operator",
    [
        chain("preconditioner", {"name": "cagrad", "c": 0.4}, PCGrad()),
        build("operators", "dispatch", {"rules": {"means": {"name": "soft", "strength": 0.5}}}),
    ],
    ids=["chain", "dispatch"],
)
def test_configurations_of_nested_operators_are_read_back(operator):
    written = json.loads(json.dumps(operator.model_dump(mode="json")))
    assert type(operator).model_validate(written) == operator
    assert hash(type(operator).model_validate(written)) == hash(operator)


@pytest.mark.parametrize("links", [["graddrop"], [{"name": "pcgrad", "granularity": "kind"}], [3]])
def test_links_that_cannot_be_combined_are_refused(links):
    with pytest.raises(ValidationError):
        Chain(links=links)


def test_an_unknown_link_is_refused_with_a_suggestion():
    with pytest.raises(UserError, match="pcgrad"):
        chain("pcgrd")


def selection(operator, views, blocks=()):
    class Backbone:
        @staticmethod
        def trained_blocks():
            return blocks

    return selection_of(
        operator=operator, backbone=Backbone(), names={"operator": "it"}, views_per_step=views
    )


def test_objections_of_links_are_passed_on():
    assert PCGrad().views == ViewCounts()
    found = chain("pcgrad", "anchors").crossgrad_validate_selection(selection(PCGrad(), 3))
    assert any("anchors needs K = 2" in reason for reason in found)
    assert any("labelled views" in reason for reason in found)


def test_rules_for_blocks_that_do_not_exist_are_refused():
    operator = Dispatch(rules={"f_dcc": "sum", "geometry": "mean"})
    (found,) = operator.crossgrad_validate_selection(selection(operator, 2))
    assert "'f_dcc'" in found


@pytest.mark.parametrize("answer", [None, (np.eye(3), EMPTY_STATE), (None, EMPTY_STATE)])
@pytest.mark.parametrize(
    "outer",
    [chain("sum", "pcgrad"), Dispatch(rules={"geometry": "pcgrad", "appearance": "pcgrad"})],
)
def test_a_wrong_result_of_an_inner_operator_names_this_operator(ask, monkeypatch, outer, answer):
    monkeypatch.setattr(PCGrad, "transform", lambda self, *_: answer)
    with pytest.raises(UserError) as caught:
        ask(outer, ROWS)
    assert "PCGrad" in f"{caught.value.what} {caught.value.where}"

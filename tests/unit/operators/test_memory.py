"""Operators that remember: what they learn, and that a resumed run goes on exactly."""

import json

import numpy as np
import pytest
import torch

from crossgrad_core.contract.blocks import EMPTY_STATE, PluginState
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import build

CONFLICT = np.array([[1.0, 0.0], [-0.5, 1.0]])
AGREEMENT = np.array([[1.0, 0.0], [0.5, 1.0]])


def repeat(ask, operator, rows, steps, state=EMPTY_STATE, **circumstances):
    for _ in range(steps):
        found = ask(operator, rows, state=state, **circumstances)
        state = found.state
    return found


def revived(state):
    """As a checkpoint gives it back."""
    values = json.loads(json.dumps(dict(state.values)))
    tensors = {name: tensor.clone() for name, tensor in state.tensors.items()}
    rows = {name: tensor.clone() for name, tensor in state.per_primitive.items()}
    return PluginState(values, tensors, rows)


def test_gradvac_rotates_gradients_to_the_averaged_cosine(context_of, ask):
    state = repeat(ask, "gradvac", AGREEMENT, 60).state
    usual = AGREEMENT[0] @ AGREEMENT[1] / np.linalg.norm(AGREEMENT[1])
    gramians = (CONFLICT @ CONFLICT.T)[None]
    operator = build("operators", "gradvac", {})
    rng = np.random.default_rng(0)
    matrices, _ = operator.transform(gramians, context_of(gramians), state, rng)
    turned = matrices[0] @ CONFLICT
    for v, partner in ((turned[0], CONFLICT[1]), (turned[1], CONFLICT[0])):
        assert v @ partner / np.linalg.norm(v) / np.linalg.norm(partner) == pytest.approx(usual)


def test_confgate_projects_only_after_repeated_conflicts(ask):
    operator = build("operators", "confgate", {})
    waiting = repeat(ask, operator, CONFLICT, 100)
    np.testing.assert_array_equal(waiting.weights, [1, 1])
    believed = ask(operator, CONFLICT, state=waiting.state)
    np.testing.assert_allclose(believed.weights, ask("symmetric", CONFLICT).weights)
    agreed = ask(operator, AGREEMENT, state=believed.state)
    np.testing.assert_array_equal(agreed.weights, [1, 1])


def test_confgate_does_not_project_a_rare_conflict(ask):
    operator = build("operators", "confgate", {})
    used_to_agree = repeat(ask, operator, AGREEMENT, 150).state
    np.testing.assert_array_equal(ask(operator, CONFLICT, state=used_to_agree).weights, [1, 1])


def test_confgate_low_detects_conflict_sooner_than_v2(ask):
    """Cosines are about -1 and +1, and slightly more are -1. P(conflict) stays around 0.8."""
    signs = np.where(np.random.default_rng(0).random(600) < 0.54, -1.0, 1.0)
    gates = {}
    for preset in ("v2", "low"):
        operator, state = build("operators", "confgate", {"variant": preset}), EMPTY_STATE
        projected = 0
        for sign in signs:
            rows = np.array([[1.0, 0.0], [0.95 * sign, 0.3]])
            found = ask(operator, rows, state=state)
            state, projected = found.state, projected + (found.weights[0] > 1)
        gates[preset] = projected
    assert 0 < gates["v2"] < gates["low"]


@pytest.mark.parametrize("rows", [[[1.0, 0.0], [0.0, 0.0]], [[1.0, 0.0], [0.0, 1.0]]])
def test_confgate_does_not_count_zero_or_disjoint_pairs(rows, ask):
    state = repeat(ask, "confgate", np.array(rows), 5).state
    assert not state.tensors["moments"].any()


def test_gradnorm_equalises_the_gradient_norms(ask):
    rows = np.array([[10.0, 0.0], [0.0, 1.0]])
    found = repeat(ask, "gradnorm", rows, 400)
    lengths = found.weights * np.linalg.norm(rows, axis=1)
    assert lengths[0] / lengths[1] == pytest.approx(1, rel=0.06)
    assert found.weights.sum() == pytest.approx(2)


def test_gradnorm_favours_the_group_whose_loss_decreases_slowly(ask):
    rows = np.array([[1.0, 0.0], [0.0, 1.0]])
    state = repeat(ask, "gradnorm", rows, 50, losses=[1.0, 1.0]).state
    found = repeat(ask, "gradnorm", rows, 300, state=state, losses=[1.0, 0.5])
    assert found.weights[0] > found.weights[1]


def test_gradnorm_gives_all_views_of_a_group_the_same_weight(ask):
    rows = np.random.default_rng(0).standard_normal((4, 6)) * [[9.0], [1.0], [9.0], [1.0]]
    weights = repeat(ask, "gradnorm", rows, 50).weights
    assert weights[0] == weights[2] < weights[1] == weights[3]
    assert weights[:2].sum() == pytest.approx(2)


def test_gradnorm_requires_labels(context_of):
    import dataclasses

    gramians = np.eye(2)[None]
    context = dataclasses.replace(context_of(gramians), labels=None)
    operator = build("operators", "gradnorm", {})
    with pytest.raises(UserError, match="the group of each view"):
        operator.transform(gramians, context, EMPTY_STATE, np.random.default_rng(0))


@pytest.mark.parametrize("name", ["gradvac", "confgate", "gradnorm", "dispatch"])
def test_a_resumed_operator_continues_exactly(name, ask):
    rng = np.random.default_rng(0)
    steps = rng.standard_normal((130, 2, 4)) - 0.2
    state = resumed = EMPTY_STATE
    for rows in steps:
        found, again = ask(name, rows, state=state), ask(name, rows, state=resumed)
        np.testing.assert_array_equal(found.weights, again.weights)
        state, resumed = found.state, revived(again.state)


@pytest.mark.parametrize("name", ["gradvac", "confgate", "gradnorm"])
def test_per_primitive_memory_follows_its_primitives(name, context_of):
    rng = np.random.default_rng(0)
    rows = rng.standard_normal((5, 2, 3))
    gramians = rows @ rows.transpose(0, 2, 1)
    blocks = ("means",) * 4 + ("mlp",)
    operator = build("operators", name, {"granularity": "gaussian"})
    context = context_of(gramians, blocks=blocks)
    _, state = operator.transform(gramians, context, EMPTY_STATE, rng)
    (kept,) = (t for key, t in state.per_primitive.items() if key.endswith("/means"))
    assert len(kept) == 4
    moved = state.gathered(torch.tensor([3, 2, 1, 0]), torch.zeros(4, dtype=torch.bool))
    turn = [3, 2, 1, 0, 4]
    _, one = operator.transform(gramians, context, state, np.random.default_rng(1))
    context = context_of(gramians[turn], blocks=blocks)
    _, other = operator.transform(gramians[turn], context, moved, np.random.default_rng(1))
    for key, tensor in one.per_primitive.items():
        assert torch.equal(tensor.flip(0), other.per_primitive[key])

"""Topology edits keep parameters, moments and statistics aligned."""

from copy import deepcopy

import pytest
import torch

from crossgrad_core.contract.blocks import (
    EMPTY_STATE,
    Block,
    Edit,
    LearningRate,
    PluginState,
    Rows,
    apply_to_moment,
    apply_to_parameters,
    gather_indices,
)

BLOCKS = (
    Block("means", ("means",), True, "geometry", LearningRate(1.0)),
    Block("mlp", ("mlp.weight", "mlp.bias"), False, "neutral", LearningRate(1.0)),
)


def parameters():
    return {
        "means": torch.arange(8.0).reshape(4, 2).requires_grad_(),
        "mlp.weight": torch.ones(3, 3, requires_grad=True),
        "mlp.bias": torch.ones(3, requires_grad=True),
    }


def test_gather_expresses_remove_duplicate_and_append():
    old = parameters()
    edit = Edit(source=torch.tensor([0, 2, 2, 3]), fresh=torch.tensor([False, False, True, False]))
    new = apply_to_parameters(edit, BLOCKS, old)
    assert new["means"].tolist() == [[0, 1], [4, 5], [4, 5], [6, 7]]
    assert new["means"].requires_grad and new["means"].is_leaf
    assert new["mlp.weight"] is old["mlp.weight"]


def test_new_rows_have_zero_moments_and_other_rows_keep_their_moments():
    moment = torch.tensor([1.0, 2.0, 3.0, 4.0])
    edit = Edit(source=torch.tensor([3, 0, 0]), fresh=torch.tensor([False, False, True]))
    assert apply_to_moment(edit, "means", moment).tolist() == [4.0, 1.0, 0.0]


def test_overwritten_rows_lose_their_moments_unless_requested_otherwise():
    moment = torch.tensor([1.0, 2.0, 3.0])
    rows = Rows(torch.zeros(1), rows=torch.tensor([1]))
    assert apply_to_moment(Edit(values={"o": rows}), "o", moment).tolist() == [1.0, 0.0, 3.0]
    kept = Rows(torch.zeros(1), rows=torch.tensor([1]), keep_moments=True)
    assert apply_to_moment(Edit(values={"o": kept}), "o", moment).tolist() == [1.0, 2.0, 3.0]


def test_new_rows_can_be_added_without_a_gather():
    edit = Edit(fresh=torch.tensor([False, True, False]))
    assert not edit.is_empty
    assert apply_to_moment(edit, "means", torch.tensor([1.0, 2.0, 3.0])).tolist() == [1.0, 0.0, 3.0]


def test_overwriting_rows_without_a_gather_does_not_change_the_old_tensor():
    old = parameters()
    edit = Edit(values={"means": Rows(torch.full((4, 2), 9.0))})
    new = apply_to_parameters(edit, BLOCKS, old)
    assert new["means"].tolist() == [[9, 9]] * 4
    assert old["means"].tolist()[1] == [2, 3]


def test_per_primitive_state_follows_the_edit():
    state = PluginState(values={"a": 1}, per_primitive={"count": torch.tensor([5.0, 6.0])})
    source, fresh = gather_indices(Edit(source=torch.tensor([1, 1, 0])), 2, torch.device("cpu"))
    fresh[1] = True
    moved = state.gathered(source, fresh)
    assert moved.per_primitive["count"].tolist() == [6.0, 0.0, 5.0]
    assert moved.values == {"a": 1}


def test_the_shared_empty_state_cannot_be_changed():
    for part in (EMPTY_STATE.values, EMPTY_STATE.tensors, EMPTY_STATE.per_primitive):
        with pytest.raises(TypeError):
            part["steps"] = 1
    copy = deepcopy(EMPTY_STATE)
    assert copy == EMPTY_STATE and copy.values is not EMPTY_STATE.values

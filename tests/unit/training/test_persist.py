"""A checkpoint is held against the run that it is to continue."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from crossgrad_core.contract.blocks import AdamState, Block, LearningRate
from crossgrad_core.errors import UserError
from crossgrad_core.run.load_run import from_checkpoint, to_checkpoint
from crossgrad_core.training.rngs import make_streams
from crossgrad_core.training.state import TrainState

MEANS = Block("means", ("means",), True, "geometry", LearningRate(0.1))
LEVELS = Block("levels", ("levels",), True, "geometry", LearningRate(0.0))
SETUP = SimpleNamespace(
    blocks=(MEANS, LEVELS),
    trained_blocks=(MEANS,),
    device=torch.device("cpu"),
    config=SimpleNamespace(seed=0),
    per_photo=False,
)


def checkpoint():
    moments = {"means": torch.ones(2, 3)}
    return to_checkpoint(
        TrainState(
            tensors={"means": torch.zeros(2, 3), "levels": torch.arange(2)},
            moments=AdamState(dict(moments), dict(moments), {"means": 3}),
            rngs=make_streams(0),
            step=3,
        )
    )


def test_frozen_integer_tensors_are_restored():
    state = from_checkpoint(SETUP, checkpoint())
    assert state.parameters["levels"].dtype == torch.int64
    assert state.parameters["means"].requires_grad


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"parameters": {"means": torch.zeros(2, 3)}}, "no levels"),
        ({"parameters": {"means": torch.zeros(2, 3).int(), "levels": torch.arange(2)}}, "means"),
        ({"parameters": {"means": torch.zeros(3, 3), "levels": torch.arange(2)}}, "torch.Size"),
        ({"exp_avg": {"means": torch.ones(5, 3)}}, "means"),
        ({"exp_avg_sq": {"gone": torch.ones(2, 3)}}, "gone"),
        ({"generators": {}}, "KeyError"),
        ({"scalars": {}}, "KeyError"),
    ],
)
def test_a_checkpoint_of_another_run_gives_one_error(changes, found):
    with pytest.raises(UserError, match="does not match the run") as caught:
        from_checkpoint(SETUP, replace(checkpoint(), **changes))
    assert found in caught.value.found
    assert caught.value.where
    assert caught.value.todo

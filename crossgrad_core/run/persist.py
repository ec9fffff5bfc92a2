"""TrainState to checkpoint and back."""

from dataclasses import asdict
from typing import Any, cast

from crossgrad_core.contract.adam_state import AdamState
from crossgrad_core.contract.contexts import StepRecord
from crossgrad_core.contract.state import Json
from crossgrad_core.run.checkpoint.contents import Checkpoint
from crossgrad_core.training.rngs import restored_streams, stream_states
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import Clock, Counters, TrainState


def to_checkpoint(state: TrainState) -> Checkpoint:
    """The state as a checkpoint; tensors are shared, not copied."""
    scalars: dict[str, Any] = {
        "clock": asdict(state.clock),
        "counters": asdict(state.counters),
        "rewinds": state.rewinds,
        "last": None if state.last is None else asdict(state.last),
    }
    return Checkpoint(
        step=state.step,
        parameters={name: tensor.detach() for name, tensor in state.parameters.items()},
        exp_avg=state.adam.exp_avg,
        exp_avg_sq=state.adam.exp_avg_sq,
        adam_steps=state.adam.steps,
        plugins=state.states,
        generators=stream_states(state.rngs),
        scalars=cast("dict[str, Json]", scalars),
    )


def from_checkpoint(setup: Setup, checkpoint: Checkpoint) -> TrainState:
    """The state that continues bit for bit where the checkpoint was written."""
    scalars = cast("dict[str, Any]", checkpoint.scalars)
    trained = {name for block in setup.trained_blocks for name in block.tensors}
    device = setup.device
    return TrainState(
        parameters={
            name: tensor.to(device).requires_grad_(name in trained)
            for name, tensor in checkpoint.parameters.items()
        },
        adam=AdamState(
            exp_avg={name: tensor.to(device) for name, tensor in checkpoint.exp_avg.items()},
            exp_avg_sq={name: tensor.to(device) for name, tensor in checkpoint.exp_avg_sq.items()},
            steps=dict(checkpoint.adam_steps),
        ),
        rngs=restored_streams(checkpoint.generators),
        states={name: state.to(device) for name, state in checkpoint.plugins.items()},
        step=checkpoint.step,
        last=_record(scalars["last"]),
        counters=Counters(**scalars["counters"]),
        clock=Clock(**scalars["clock"]),
        rewinds=scalars["rewinds"],
    )


def _record(plain: dict[str, Any] | None) -> StepRecord | None:
    if plain is None:
        return None
    labels = plain["labels"]
    return StepRecord(
        **{
            **plain,
            "views": tuple(plain["views"]),
            "names": tuple(plain["names"]),
            "labels": None if labels is None else tuple(labels),
            "losses": tuple(plain["losses"]),
        }
    )

"""Looks at the state: a run keeps, evaluates and goes back to states that were looked at."""

from crossgrad_core.contract.contexts import StepRecord
from crossgrad_core.gradients.finite import is_finite
from crossgrad_core.training.failure import NonFiniteError, TrainingFailedError
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState


def are_parameters_finite(state: TrainState) -> bool:
    """Whether no parameter is NaN or infinite."""
    state.late.finish()
    return all(is_finite(tensor) for tensor in state.tensors.values())


def check_parameters(state: TrainState) -> None:
    """Raises NonFiniteError where a parameter is NaN or infinite after a step."""
    state.late.finish()
    for name, tensor in state.tensors.items():
        if not is_finite(tensor):
            views = () if state.last is None else state.last.names
            raise NonFiniteError(state.step, views, f"block {name}")


def check_start(state: TrainState) -> None:
    """Refuses to train from a state that is bad already: nothing could be gone back to.

    Raises:
        TrainingFailedError: A parameter or moment is NaN or infinite; names it.
    """
    parts = {
        "block": state.parameters,
        "the first moment of": state.adam.exp_avg,
        "the second moment of": state.adam.exp_avg_sq,
    }
    for kind, tensors in parts.items():
        for name, tensor in tensors.items():
            if not is_finite(tensor):
                raise TrainingFailedError(
                    f"{kind} {name} is not finite in the state of step {state.step} that training "
                    f"was to go on from; {_way_out(state.step)}"
                )


def _way_out(step: int) -> str:
    if step == 0:
        return "look at the Gaussians of --init, or at what changes the first parameters"
    return f"remove checkpoints/step-{step:06d} to go on from an earlier one, where there is one"


def check_dropped(setup: Setup, state: TrainState, record: StepRecord) -> None:
    """Stops a run that had to drop too many non-finite gradients."""
    if state.counters.dropped >= setup.config.max_nonfinite_blocks:
        raise TrainingFailedError(
            f"{state.counters.dropped} blocks of single views were dropped because their gradient "
            f"was not finite, the last in step {state.step} (views {', '.join(record.names)})"
        )

"""The last good state, to which training returns when a step is cut short."""

from crossgrad_core.training.checks import are_parameters_finite, check_parameters
from crossgrad_core.training.state import Snapshot, StepSnapshot, TrainState


class RollbackGuard:
    """Holds the state before the step under way, and a copy of an earlier good one.

    Most of what can go wrong in a step (sampling, a photo, rendering, an operator, the memory)
    does so before parameters change: then only the step under way is lost. Where an optimizer step
    or an edit was cut short, the copy takes their place. Only a state that was looked at is copied.

    Args:
        state: The state that training starts from, which was looked at.
    """

    def __init__(self, state: TrainState) -> None:
        self._snapshot = Snapshot.of(state)
        self._mark = self._snapshot.mark
        self._looked = state.step
        state.touched = False

    def commit(self, state: TrainState, *, look: bool = False) -> None:
        """Notes that a step is complete.

        Raises:
            NonFiniteError: `look` was asked for, and a parameter is NaN or infinite.
        """
        if look:
            self.check(state)
        self._mark = StepSnapshot.of(state)
        state.touched = False

    def check(self, state: TrainState) -> None:
        """Looks at the parameters, unless that was done after this very step.

        Raises:
            NonFiniteError: One of them is NaN or infinite.
        """
        if self._looked != state.step:
            check_parameters(state)
            self._looked = state.step

    def copy(self, state: TrainState) -> None:
        """Takes this state as the one to go back to.

        Raises:
            NonFiniteError: A parameter is NaN or infinite.
        """
        self.check(state)
        self._snapshot = Snapshot.of(state)

    def rewind(self, state: TrainState, seed: int) -> None:
        """Puts `state` back to the copy, with fresh random streams."""
        self._snapshot.restore(state, seed)
        self._looked = state.step
        self.commit(state)

    def restore(self, state: TrainState) -> None:
        """Puts `state` back to the last complete step, or further back to the copy.

        It is for the end of training: there may be no copy afterwards.
        """
        for tensor in state.tensors.values():
            tensor.grad = None
        if not state.touched and is_whole(state):
            self._mark.restore(state)
        else:
            self._snapshot.hand_over(state)
            state.touched = False


def is_whole(state: TrainState) -> bool:
    """Whether all parameters are finite, as far as the machine lets it be seen."""
    try:
        return are_parameters_finite(state)
    except Exception:  # Its last step has failed, there is no memory for it, or the GPU failed.
        return False

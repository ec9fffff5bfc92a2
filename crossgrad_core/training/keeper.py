"""What training goes back to when a step is cut short."""

import torch

from crossgrad_core.training.state import Mark, Snapshot, TrainState


class Keeper:
    """Knows the state before the step under way, and a copy of an earlier good one.

    Most of what can go wrong in a step (sampling, a photo, rendering, an operator, the memory)
    does so before parameters change: then only the step under way is lost. Where an optimizer step
    or an edit was cut short, the copy takes their place.

    Args:
        state: The state that training starts from.
    """

    def __init__(self, state: TrainState) -> None:
        self.snapshot = Snapshot.of(state)
        self._mark = self.snapshot.mark
        state.touched = False

    def settle(self, state: TrainState) -> None:
        """Notes that a step is complete."""
        self._mark = Mark.of(state)
        state.touched = False

    def restore(self, state: TrainState) -> None:
        """Puts `state` back to the last complete step, or further back to the copy."""
        for tensor in state.parameters.values():
            tensor.grad = None
        if not state.touched and _finite(state):
            self._mark.restore(state)
        else:
            self.snapshot.put_back(state)
            state.touched = False


def _finite(state: TrainState) -> bool:
    return all(bool(torch.isfinite(tensor).all()) for tensor in state.parameters.values())

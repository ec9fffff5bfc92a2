"""The running state of the loop: all that changes, and all that a checkpoint holds."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from crossgrad_core.blocks import Parameters, primitives_of
from crossgrad_core.contexts import StepRecord
from crossgrad_core.optimizer import AdamState
from crossgrad_core.state import PluginState
from crossgrad_core.training.rngs import make_streams
from crossgrad_core.training.setup import Setup


@dataclass
class Counters:
    """What was done so far.

    Attributes:
        views: Rendered training views.
        backward_passes: Backward passes.
        dropped: Blocks of views that were dropped because their gradient was not finite.
    """

    views: int = 0
    backward_passes: int = 0
    dropped: int = 0


@dataclass
class Clock:
    """Seconds by what they were spent on; only `train` counts as training."""

    train: float = 0.0
    compile: float = 0.0
    load: float = 0.0
    evaluate: float = 0.0
    report: float = 0.0


@dataclass
class TrainState:
    """Everything that a step reads and writes."""

    parameters: Parameters
    adam: AdamState
    rngs: dict[str, np.random.Generator]
    states: dict[str, PluginState] = field(default_factory=dict)
    step: int = 0
    last: StepRecord | None = None
    counters: Counters = field(default_factory=Counters)
    clock: Clock = field(default_factory=Clock)
    rewinds: int = 0

    def primitives(self, setup: Setup) -> int:
        """Number of primitives."""
        return primitives_of(setup.blocks, self.parameters)

    def commit(self, states: Mapping[str, PluginState]) -> None:
        """Takes over the plugin states that a seam answered with."""
        self.states.update(states)


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A copy of the last good state, to rewind to."""

    parameters: Parameters
    adam: AdamState
    states: dict[str, PluginState]
    step: int
    last: StepRecord | None

    @classmethod
    def of(cls, state: TrainState) -> "Snapshot":
        """A deep copy of what training changes. Plugin states are values and need no copy."""
        return cls(
            parameters={name: t.detach().clone() for name, t in state.parameters.items()},
            adam=copied_moments(state.adam),
            states=dict(state.states),
            step=state.step,
            last=state.last,
        )

    def restore(self, state: TrainState, seed: int) -> None:
        """Puts `state` back, with fresh random streams so that the same draw does not recur."""
        state.parameters = {
            name: t.clone().requires_grad_(state.parameters[name].requires_grad)
            for name, t in self.parameters.items()
        }
        state.adam = copied_moments(self.adam)
        state.states = dict(self.states)
        state.step = self.step
        state.last = self.last
        state.rewinds += 1
        state.rngs = make_streams(seed, state.rewinds)


def copied_moments(adam: AdamState) -> AdamState:
    """A deep copy."""
    return AdamState(
        exp_avg={name: tensor.clone() for name, tensor in adam.exp_avg.items()},
        exp_avg_sq={name: tensor.clone() for name, tensor in adam.exp_avg_sq.items()},
        steps=dict(adam.steps),
    )

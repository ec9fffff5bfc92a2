"""The loop around the step: evaluation, checkpoints, interruption, rewinding."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from time import perf_counter
from types import FrameType
from typing import Literal, Protocol

import torch

from crossgrad_core.contexts import StepRecord
from crossgrad_core.training.failure import NonFiniteError, TrainingFailedError
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import Snapshot, TrainState
from crossgrad_core.training.step import take_step
from crossgrad_core.training.views import model_of

Status = Literal["finished", "stopped", "paused"]

#: Steps between looks at all parameters. Losses and gradients are looked at in every step; a bad
#: parameter that touches neither (a Gaussian that is not drawn any more) can wait so long.
CHECK_EVERY = 10
#: Steps between copies of the last good state; a multiple of `CHECK_EVERY`.
SNAPSHOT_EVERY = 100


class Sink(Protocol):
    """Where a run's results go."""

    def evaluate(self, setup: Setup, state: TrainState) -> None:
        """Evaluates and records a row."""
        ...

    def save(self, setup: Setup, state: TrainState) -> None:
        """Writes a checkpoint."""
        ...

    def rewind(self, setup: Setup, step: int) -> None:
        """Forgets what was recorded after `step`."""
        ...


@dataclass
class Stopper:
    """Turns the first interrupt into a request to stop after the step; the second one is final."""

    requested: bool = field(default=False)

    @contextmanager
    def installed(self) -> Iterator["Stopper"]:
        """Handles SIGINT and SIGTERM inside the block; does nothing outside the main thread."""
        try:
            before = {s: signal.signal(s, self._handle) for s in (signal.SIGINT, signal.SIGTERM)}
        except ValueError:  # Signals can be handled in the main thread only.
            yield self
            return
        try:
            yield self
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True


def train(
    setup: Setup,
    state: TrainState,
    sink: Sink,
    stopper: Stopper,
    pauses: Callable[[TrainState], bool] | None = None,
) -> Status:
    """Runs the remaining steps of the schedule, or those until `pauses` says so after a step.

    Raises:
        TrainingFailedError: Something was not finite twice; names step, views and block. `state`
            is then the last good one.
    """
    total = setup.schedule.total
    last = min(total, setup.config.stop_after or total)
    snapshot = Snapshot.of(state)
    while state.step < last and not stopper.requested:
        try:
            record = timed_step(setup, state)
            leaves = state.step == last or stopper.requested
            if state.step % CHECK_EVERY == 0 or leaves:
                check_parameters(state, record)
            if state.step % SNAPSHOT_EVERY == 0:
                snapshot = Snapshot.of(state)
        except NonFiniteError as error:
            _rewind(setup, state, snapshot, error)
            sink.rewind(setup, state.step)
            continue
        check_dropped(setup, state, record)
        setup.hook.crossgrad_step_end(record=record)
        if setup.shows_model:
            setup.hook.crossgrad_model(model=model_of(setup, state))
        _tell_held_back(setup, record)
        _record(setup, state, sink)
        if pauses is not None and state.step < last and pauses(state):
            return "paused"
    return "finished" if state.step >= total else "stopped"


def timed_step(setup: Setup, state: TrainState) -> StepRecord:
    """One step on the training clock; decoding photos is counted as loading."""
    start, loaded = perf_counter(), state.clock.load
    record = take_step(setup, state)
    if setup.device.type == "cuda":
        torch.cuda.synchronize(setup.device)
    state.clock.train += perf_counter() - start - (state.clock.load - loaded)
    state.last = replace(record, train_seconds=state.clock.train)
    return state.last


def check_parameters(state: TrainState, record: StepRecord) -> None:
    """Raises NonFiniteError where a parameter is NaN or infinite."""
    for name, tensor in state.parameters.items():
        if not bool(torch.isfinite(tensor.detach()).all()):
            raise NonFiniteError(state.step, record.names, f"block {name}")


def check_dropped(setup: Setup, state: TrainState, record: StepRecord) -> None:
    """Stops a run that had to drop too many non-finite gradients."""
    if state.counters.dropped >= setup.config.max_dropped:
        raise TrainingFailedError(
            f"{state.counters.dropped} blocks of single views were dropped because their gradient "
            f"was not finite, the last in step {state.step} (views {', '.join(record.names)})"
        )


def _rewind(setup: Setup, state: TrainState, snapshot: Snapshot, error: NonFiniteError) -> None:
    rewound_before = state.rewinds > 0
    snapshot.restore(state, setup.config.seed)
    if rewound_before:
        raise TrainingFailedError(f"{error}, for the second time") from error
    setup.hook.crossgrad_message(
        text=f"{error}: rewound to step {state.step}, the last good state; random streams renewed"
    )


def _tell_held_back(setup: Setup, record: StepRecord) -> None:
    held_back = record.counts.get("held_back", 0)
    if held_back > 0:
        setup.hook.crossgrad_message(
            text=f"step {record.step}: growth held back by {held_back} primitives "
            "(--max-gaussians or the memory guard)"
        )


def _record(setup: Setup, state: TrainState, sink: Sink) -> None:
    total, step = setup.schedule.total, state.step
    # What the run was planned with: its length may follow the clock, the interval does not.
    planned = setup.config.steps or total
    eval_every = setup.config.eval_every or max(1, planned // 10)
    save_every = setup.config.save_every or max(1, planned // 5)
    if step % eval_every == 0 and step < total:
        sink.evaluate(setup, state)
    if step % save_every == 0 and step < total:
        sink.save(setup, state)

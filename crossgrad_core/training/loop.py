"""The training loop: steps, evaluation, checkpoints, interruption, rollback."""

import signal
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass, field, replace
from types import FrameType
from typing import Any, Literal, Protocol

import numpy as np

from crossgrad_core.contract.blocks import EMPTY_STATE, PluginState
from crossgrad_core.contract.contexts import StepRecord
from crossgrad_core.contract.slots.sampler import STATE
from crossgrad_core.system.allocator import use_large_pages
from crossgrad_core.system.interrupts import end_at_once, signal_names, tell
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import (
    NonFiniteError,
    PhaseTimer,
    RollbackGuard,
    TrainingFailedError,
    TrainState,
    check_dropped,
    check_start,
    is_whole,
)
from crossgrad_core.training.step import model_of, sample_context, take_step
from crossgrad_core.training.views import photo_camera

#: Messages after the first and after the second signal. A third signal ends the process at once.
_WORDS = (
    (
        "stopping: the current state is saved and evaluated first (press again to "
        "skip the evaluation)"
    ),
    "stopping: the current state is saved first (press again to end at once)",
)


@dataclass
class Stopper:
    """A request to stop a run, together with its reason.

    Attributes:
        signal: Number of the first signal; None before the first signal.
        at_once: True after a second signal. If `at_once` is True, optional work, such as the
            evaluation, is skipped.
        error: Error from outside the training step that ends the run; None without an error.
    """

    signal: int | None = None
    at_once: bool = False
    error: Exception | None = None
    _interruptible: bool = field(default=False, repr=False)
    _count: int = field(default=0, repr=False)
    _before: dict[int, Any] = field(default_factory=dict, repr=False)

    @property
    def requested(self) -> bool:
        """True if training must stop after the present step."""
        return self.signal is not None or self.error is not None

    def fail(self, error: Exception) -> None:
        """Request the end of the run after the present step, because a thread raised an error."""
        self.error = error

    @contextmanager
    def installed(self) -> Iterator["Stopper"]:
        """Handle signals inside the block. Outside the main thread, this method does nothing.

        Signals that the process already ignores (for example under `nohup`) are still ignored.
        """
        before = self._before
        try:
            for number in signal_names():
                before[number] = signal.signal(number, self._handle)
        except ValueError:  # Python allows signal handlers only in the main thread.
            yield self
            return
        try:
            yield self
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    @contextmanager
    def interruptible(self) -> Iterator[None]:
        """Let a second signal raise KeyboardInterrupt in the block.

        Outside the block, the signal is only recorded.
        """
        self._interruptible = not self.at_once
        try:
            yield
        finally:
            self._interruptible = False

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self._count += 1
        if self._count > len(_WORDS):
            self._end(number, frame)
        tell(_WORDS[self._count - 1])
        if self.signal is None:
            self.signal = number
            return
        self.at_once = True
        if self._interruptible:
            self._interruptible = False
            raise KeyboardInterrupt

    def _end(self, number: int, frame: FrameType | None) -> None:
        """Call the previous signal handler, which should end the process.

        If the process is still running, raise KeyboardInterrupt.
        """
        before = self._before.get(number)
        (before if callable(before) else end_at_once)(number, frame)
        raise KeyboardInterrupt


#: Prefetch at least this many views and at least this many steps.
_VIEWS, _STEPS = 8, 2


class Prefetcher:
    """A prefetcher of photos.

    The prefetcher predicts the next views, and threads decode the photos of these views.

    The prefetcher draws the next views with copies of the sampler's random generator and state. The
    prediction only decides which photos are decoded first. The prediction may be wrong if the
    sampler uses the losses of the previous step. The prefetcher does not change the training state.

    Args:
        setup: Setup of the run.
    """

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        self._draws: deque[tuple[int, ...]] = deque()
        self._step = 0
        self._rng = np.random.default_rng(0)
        self._state: PluginState = EMPTY_STATE
        self._blind = False

    def update(self, state: TrainState) -> None:
        """Pass the photos of the steps after `state.step` to the decoding threads."""
        setup = self._setup
        if self._blind or not setup.photos_ahead.useful:
            return
        try:
            self._follow(state)
            self._draw(state)
            views = [setup.train_views[index] for draw in self._draws for index in draw]
        # Ignore an error of the sampler here. The training step calls the sampler again and reports
        # the error.
        except Exception:
            self._blind = True
            return
        scale = max(state.last.scales, default=1.0) if state.last is not None else 1.0
        small = setup.scaled_photos
        wanted = [v for v in views if not small.holds(v, photo_camera(setup, v, scale))]
        setup.photos_ahead.expect(wanted)

    def _follow(self, state: TrainState) -> None:
        """Drop the prediction for the last step.

        If the prediction for the last step was wrong, drop all predictions.
        """
        if self._draws and self._step - len(self._draws) == state.step - 1:
            drawn = self._draws.popleft()
            if state.last is not None and state.last.views == drawn:
                return
        elif self._draws and self._step - len(self._draws) == state.step:
            return
        self._draws.clear()
        self._step = state.step
        self._rng = deepcopy(state.rngs[STATE])
        self._state = state.states.get(STATE, EMPTY_STATE)

    def _draw(self, state: TrainState) -> None:
        setup = self._setup
        while self._step < setup.schedule.total and not self._enough():
            context = replace(
                sample_context(setup, state, self._step + 1),
                rng=self._rng,
                states={**state.states, STATE: self._state},
            )
            draw, self._state = setup.sampler.sample(context, self._state)
            self._draws.append(tuple(map(int, draw.views)))
            self._step += 1

    def _enough(self) -> bool:
        return len(self._draws) >= _STEPS and sum(map(len, self._draws)) >= _VIEWS


#: Reason why the training loop returned.
Ending = Literal["finished", "stopped", "paused"]
#: Number of steps between two checks of all parameters. Losses and gradients are checked in every
#: step. A non-finite parameter may affect neither the loss nor the gradients, for example if its
#: Gaussian is no longer rendered. The check of all parameters finds such a parameter.
CHECK_EVERY = 10
#: Number of steps between two copies of the last good state. The number is a multiple of
#: `CHECK_EVERY`.
SNAPSHOT_EVERY = 100


class RunWriter(Protocol):
    """An object that writes the results of a run."""

    def evaluate(self, setup: Setup, state: TrainState) -> None:
        """Evaluate the model and record the metrics."""
        ...

    def save(self, setup: Setup, state: TrainState) -> None:
        """Write a checkpoint."""
        ...

    def rewind(self, setup: Setup, step: int) -> None:
        """Delete all records of steps after `step`."""
        ...


def train(
    setup: Setup,
    state: TrainState,
    sink: RunWriter,
    stopper: Stopper,
    pauses: Callable[[TrainState], bool] | None = None,
    guard: RollbackGuard | None = None,
) -> Ending:
    """Run the remaining steps of the schedule, or stop when `pauses` returns True after a step.

    If the caller passes an earlier `guard` after a pause, training can return to a state before the
    pause. By default, each call creates a new guard.

    Raises:
        TrainingFailedError: A value is NaN or infinite, either at the start or again after a
            rollback. The message of the error names the step, the views and the block.
        BaseException: A plugin, a photo, the memory or the disk caused an error. A note on this
            error names the step. After any exception, `state` is the last state that was finite.
    """
    check_start(state)
    use_large_pages()
    guard = guard or RollbackGuard(state)
    try:
        status = _steps(setup, state, sink, stopper, pauses, guard)
    except TrainingFailedError:
        if not is_whole(state):
            guard.restore(state)
        raise
    except BaseException as error:
        error.add_note(f"in step {state.step}")
        guard.restore(state)
        raise
    if stopper.error is not None:
        raise stopper.error
    return status


def _steps(
    setup: Setup,
    state: TrainState,
    sink: RunWriter,
    stopper: Stopper,
    pauses: Callable[[TrainState], bool] | None,
    guard: RollbackGuard,
) -> Ending:
    total = setup.schedule.total
    last = min(total, setup.config.stop_after or total)
    prefetcher = Prefetcher(setup)
    while state.step < last and not stopper.requested:
        prefetcher.update(state)
        try:
            record = timed_step(setup, state)
            leaves = state.step == last or stopper.requested
            guard.commit(state, look=leaves or looks_after(setup, state.step))
            if copies_after(setup, state.step):
                guard.copy(state)
                use_large_pages()
        except NonFiniteError as error:
            _rewind(setup, state, sink, guard, error)
            continue
        check_dropped(setup, state, record)
        setup.hook.crossgrad_step_end(record=record)
        if setup.shows_model:
            setup.hook.crossgrad_model_ready(model=model_of(setup, state))
        _tell_held_back(setup, record)
        _record(setup, state, sink)
        pausing = pauses is not None and state.step < last and pauses(state)
        if pausing and _is_good(setup, state, sink, guard):
            return "paused"
    # A signal may have arrived after the last check inside the loop.
    _is_good(setup, state, sink, guard)
    return "finished" if state.step >= total else "stopped"


def timed_step(setup: Setup, state: TrainState) -> StepRecord:
    """Take one step and count its time; the time to decode photos counts as loading time.

    A GPU or other threads may still run the optimizer when this function returns. The next step
    waits for the end of the optimizer.
    """
    state.laps = PhaseTimer()
    setup.photos_ahead.taken_cpu()
    record = take_step(setup, state)
    if setup.config.clock == "cpu" or looks_after(setup, state.step):
        # Finish deferred updates here, so that their time counts for the present step.
        state.late.finish()
    state.laps.leave_out(0.0, setup.photos_ahead.taken_cpu())
    state.laps.lap("other")
    state.clock.count(state.laps)
    state.last = replace(record, train_seconds=state.clock.train)
    return state.last


def _is_good(setup: Setup, state: TrainState, sink: RunWriter, guard: RollbackGuard) -> bool:
    """Check whether a state is finite before the state is stored; if not, roll training back.

    Return True if the state is finite.
    """
    try:
        guard.check(state)
    except NonFiniteError as error:
        _rewind(setup, state, sink, guard, error)
        return False
    return True


def _rewind(
    setup: Setup, state: TrainState, sink: RunWriter, guard: RollbackGuard, error: NonFiniteError
) -> None:
    rewound_before = state.rewinds > 0
    guard.rewind(state, setup.config.seed)
    if rewound_before:
        raise TrainingFailedError(f"{error}, for the second time") from error
    setup.hook.crossgrad_log(
        text=f"{error}: training returned to step {state.step}, the last finite state, "
        "with new random numbers"
    )
    sink.rewind(setup, state.step)


def _tell_held_back(setup: Setup, record: StepRecord) -> None:
    held_back = record.counts.get("held_back", 0)
    if held_back > 0 and setup.numbers.growth == "unbounded":
        setup.hook.crossgrad_log(
            text=f"step {record.step}: {held_back} Gaussians were not added (--max-gaussians "
            "or the memory guard)"
        )


def looks_after(setup: Setup, step: int) -> bool:
    """Return True if all parameters are checked after this step, as before a checkpoint."""
    return step % CHECK_EVERY == 0 or saves_after(setup, step) or evaluates_after(setup, step)


def copies_after(setup: Setup, step: int) -> bool:
    """Return True if the state after this step is copied for a later rollback."""
    return step % SNAPSHOT_EVERY == 0 or saves_after(setup, step)


def saves_after(setup: Setup, step: int) -> bool:
    """Return True if a checkpoint is written after this step; False for the last step."""
    return step % setup.numbers.save_every == 0 and step < setup.schedule.total


def evaluates_after(setup: Setup, step: int) -> bool:
    """Return True if held-out views are evaluated after this step; False for the last step."""
    every = setup.numbers.eval_every
    first = max(1, setup.config.eval_from)
    # Choose steps in the middle between two opacity resets, because renders are poor right after a
    # reset.
    chosen = "eval_every" not in setup.config.decided
    between = not chosen and setup.schedule.reset_every is not None
    shift = every // 2 if between else 0
    return step % every == shift and first <= step < setup.schedule.total


def _record(setup: Setup, state: TrainState, sink: RunWriter) -> None:
    if evaluates_after(setup, state.step):
        sink.evaluate(setup, state)
    if saves_after(setup, state.step):
        sink.save(setup, state)

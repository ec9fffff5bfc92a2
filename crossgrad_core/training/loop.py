"""The loop around the step: evaluation, checkpoints, interruption, rewinding."""

from collections.abc import Callable
from dataclasses import replace
from typing import Literal, Protocol

from crossgrad_core.contract.contexts import StepRecord
from crossgrad_core.system.allocator import use_large_pages
from crossgrad_core.training.checks import check_dropped, check_start
from crossgrad_core.training.clock import PhaseTimer
from crossgrad_core.training.failure import NonFiniteError, TrainingFailedError
from crossgrad_core.training.model import model_of
from crossgrad_core.training.rollback import RollbackGuard, is_whole
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState
from crossgrad_core.training.step import take_step
from crossgrad_core.training.stopper import Stopper
from crossgrad_core.training.view_prefetch import Prefetcher

#: Why the loop came back.
Ending = Literal["finished", "stopped", "paused"]

#: Steps between looks at all parameters. Losses and gradients are looked at in every step; a bad
#: parameter that touches neither (a Gaussian that is not drawn any more) can wait so long.
CHECK_EVERY = 10
#: Steps between copies of the last good state; a multiple of `CHECK_EVERY`.
SNAPSHOT_EVERY = 100


class RunWriter(Protocol):
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


def train(
    setup: Setup,
    state: TrainState,
    sink: RunWriter,
    stopper: Stopper,
    pauses: Callable[[TrainState], bool] | None = None,
    keeper: RollbackGuard | None = None,
) -> Ending:
    """Runs the remaining steps of the schedule, or those until `pauses` says so after a step.

    A `keeper` that outlives a pause goes back behind it; by default none does.

    Raises:
        TrainingFailedError: Something was not finite twice, or at the start; names step, views and
            block.
        BaseException: Whatever a plugin, a photo, the memory or the disk raised, with the step as a
            note. After any exception `state` is the last good one.
    """
    check_start(state)
    use_large_pages()
    keeper = keeper or RollbackGuard(state)
    try:
        status = _steps(setup, state, sink, stopper, pauses, keeper)
    except TrainingFailedError:
        if not is_whole(state):
            keeper.restore(state)
        raise
    except BaseException as error:
        error.add_note(f"in step {state.step}")
        keeper.restore(state)
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
    keeper: RollbackGuard,
) -> Ending:
    total = setup.schedule.total
    last = min(total, setup.config.stop_after or total)
    foresight = Prefetcher(setup)
    while state.step < last and not stopper.requested:
        foresight.update(state)
        try:
            record = timed_step(setup, state)
            leaves = state.step == last or stopper.requested
            keeper.commit(state, look=leaves or looks_after(setup, state.step))
            if copies_after(setup, state.step):
                keeper.copy(state)
                use_large_pages()
        except NonFiniteError as error:
            _rewind(setup, state, sink, keeper, error)
            continue
        check_dropped(setup, state, record)
        setup.hook.crossgrad_step_end(record=record)
        if setup.shows_model:
            setup.hook.crossgrad_model_ready(model=model_of(setup, state))
        _tell_held_back(setup, record)
        _record(setup, state, sink)
        pausing = pauses is not None and state.step < last and pauses(state)
        if pausing and _is_good(setup, state, sink, keeper):
            return "paused"
    # A signal may have come after the last look.
    _is_good(setup, state, sink, keeper)
    return "finished" if state.step >= total else "stopped"


def timed_step(setup: Setup, state: TrainState) -> StepRecord:
    """One step on the training clock; decoding photos is counted as loading.

    A GPU, or the other threads, may still be at the optimizer when the step is over; the next one
    waits for them.
    """
    state.laps = PhaseTimer()
    setup.photos_ahead.taken_cpu()
    record = take_step(setup, state)
    if setup.config.clock == "cpu" or looks_after(setup, state.step):
        state.late.finish()  # On this step's clock.
    state.laps.leave_out(0.0, setup.photos_ahead.taken_cpu())
    state.laps.lap("other")
    state.clock.count(state.laps)
    state.last = replace(record, train_seconds=state.clock.train)
    return state.last


def _is_good(setup: Setup, state: TrainState, sink: RunWriter, keeper: RollbackGuard) -> bool:
    """Checks a state that is about to be kept; where it is bad, training goes back."""
    try:
        keeper.check(state)
    except NonFiniteError as error:
        _rewind(setup, state, sink, keeper, error)
        return False
    return True


def _rewind(
    setup: Setup, state: TrainState, sink: RunWriter, keeper: RollbackGuard, error: NonFiniteError
) -> None:
    rewound_before = state.rewinds > 0
    keeper.rewind(state, setup.config.seed)
    if rewound_before:
        raise TrainingFailedError(f"{error}, for the second time") from error
    setup.hook.crossgrad_log(
        text=f"{error}: rewound to step {state.step}, the last good state; random streams renewed"
    )
    sink.rewind(setup, state.step)


def _tell_held_back(setup: Setup, record: StepRecord) -> None:
    held_back = record.counts.get("held_back", 0)
    if held_back > 0 and setup.numbers.growth == "unbounded":
        setup.hook.crossgrad_log(
            text=f"step {record.step}: growth held back by {held_back} primitives "
            "(--max-gaussians or the memory guard)"
        )


def looks_after(setup: Setup, step: int) -> bool:
    """Whether all parameters are looked at after this step: what is kept or shown is good."""
    return step % CHECK_EVERY == 0 or saves_after(setup, step) or evaluates_after(setup, step)


def copies_after(setup: Setup, step: int) -> bool:
    """Whether the state after this step is one to go back to."""
    return step % SNAPSHOT_EVERY == 0 or saves_after(setup, step)


def saves_after(setup: Setup, step: int) -> bool:
    """Whether a checkpoint is written after this step of a run that goes on."""
    every = setup.config.save_every or max(1, _planned(setup) // 5)
    return step % every == 0 and step < setup.schedule.total


def evaluates_after(setup: Setup, step: int) -> bool:
    """Whether the held-out views are evaluated after this step of a run that goes on."""
    every = setup.config.eval_every or max(1, _planned(setup) // 10)
    first = max(1, setup.config.eval_from)
    # Opacities are reset every tenth of the steps, too: right after that there is hardly a picture.
    between = setup.config.eval_every is None and setup.schedule.reset_every is not None
    shift = every // 2 if between else 0
    return step % every == shift and first <= step < setup.schedule.total


def _record(setup: Setup, state: TrainState, sink: RunWriter) -> None:
    if evaluates_after(setup, state.step):
        sink.evaluate(setup, state)
    if saves_after(setup, state.step):
        sink.save(setup, state)


def _planned(setup: Setup) -> int:
    """Steps that the run was planned with: its length may follow the clock, intervals do not."""
    return setup.config.steps or setup.schedule.total

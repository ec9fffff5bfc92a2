"""A run from its first step to its last file; the results are saved even if the run fails."""

import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from shlex import quote
from typing import Final, TypeVar

from crossgrad_core.contract.contexts import RunInfo
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import notes_on
from crossgrad_core.run.checkpoint import CHECKPOINTS, named_checkpoints
from crossgrad_core.run.results.config_file import read_notes, write_config
from crossgrad_core.run.results.log import FILE as LOG
from crossgrad_core.run.results.log import RunLog, roughly
from crossgrad_core.run.results.metrics_csv import Row, read_metrics
from crossgrad_core.run.results.seal import seal
from crossgrad_core.run.results.summary import Status, best_of
from crossgrad_core.run.session import PAGE, PANELS, Session
from crossgrad_core.scene.photos.photos_ahead import fits
from crossgrad_core.system.checksums import SUMS
from crossgrad_core.training.budget import Length, seconds_ahead
from crossgrad_core.training.loop import Stopper, evaluates_after, train
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import PhaseTimer, RollbackGuard, TrainingFailedError, TrainState
from crossgrad_core.training.step import final_edits
from crossgrad_core.wording import one_line

#: Texts in torch errors that report exhausted memory.
_NO_MEMORY = ("can't allocate memory", "not enough memory", "out of memory")


def reason_of(error: BaseException) -> str:
    """Return the reason of an error; for an unexpected error, add its type and source location."""
    if not is_unexpected(error):
        return str(error)
    text = " ".join(f"{type(error).__name__}: {error}".split()).removesuffix(":")
    if is_out_of_memory(error):
        return f"out of memory ({text}); try --max-gaussians N or --max-size PIXELS"
    return f"{text}{_place(error)}"


def is_unexpected(error: BaseException) -> bool:
    """Return True if the message of the error is not written for users."""
    return not isinstance(error, UserError | TrainingFailedError)


def is_out_of_memory(error: BaseException) -> bool:
    """Return True if the error means that there was not enough memory."""
    if isinstance(error, MemoryError):
        return True
    return isinstance(error, RuntimeError) and any(sign in str(error) for sign in _NO_MEMORY)


def traceback_of(error: BaseException) -> str:
    """Return the traceback as text."""
    return "".join(traceback.format_exception(error))


def _place(error: BaseException) -> str:
    frames = traceback.extract_tb(error.__traceback__)
    if not frames:
        return ""
    last = frames[-1]
    return f" ({Path(last.filename).name}, line {last.lineno}, in {last.name})"


#: A run reports if its last evaluation is more than this many decibels below its best evaluation.
#: With few held-out photos, smaller differences between evaluations are normal.
WORSE: Final = 0.3
_T = TypeVar("_T")


@dataclass(frozen=True)
class Ending:
    """The ending of a run.

    Attributes:
        status: `finished`, `stopped` (resumable) or `failed`.
        error: The reason of the failure and the missing results; None if nothing failed.
        traced: True if log.txt contains a traceback.
        cause: The exception that ended training; None without an exception.
    """

    status: Status
    error: str | None = None
    traced: bool = False
    cause: BaseException | None = None


@dataclass
class RunLoop:
    """A run in progress.

    Attributes:
        setup: The setup; a run with a time budget replaces the setup.
        state: The state of the training.
        session: The writer of the results.
        log: The run's log.txt.
        stopper: The requests to stop the run.
        ending: The ending so far.
    """

    setup: Setup
    state: TrainState
    session: Session
    log: RunLog
    stopper: Stopper
    ending: Ending = Ending("finished")

    def to_the_end(self, length: Length) -> Ending:
        """Train, then save and describe the final state.

        The parts run one after another. If one part fails, the remaining parts still run, and the
        ending reports the failure.
        """
        self._attempt("", lambda: self._train(length))
        if self.ending.status == "finished":
            self._attempt("the trained model was not changed", self._edit_finished)
        self._attempt("", lambda: self.session.align(self.setup, self.state))
        if self.session.gone:
            return self.ending
        # Do not save a state that a failed step changed only partly, because a run cannot continue
        # from such a state.
        if self.state.step > 0 and not self.state.touched:
            self._attempt("no checkpoint", lambda: self.session.save(self.setup, self.state))
            self._describe()
        self._summarise()
        described = self.ending
        self._attempt("", lambda: self.setup.hook.crossgrad_run_end(status=described.status))
        if self.ending != described:
            self._summarise()
        sealed = self.ending
        self._attempt(f"no {SUMS}", lambda: seal(self.session.folder))
        if self.ending != sealed:
            self._summarise()
        return self.ending

    def _train(self, length: Length) -> None:
        setup = self.setup
        keep = fits(setup.scene, setup.config.data.cache_mib)
        views = (*setup.train_views, *setup.scene.test_views)
        with (
            self.stopper.interruptible(),
            setup.photos_ahead.at_work(views, self.stopper.fail, keep=keep),
        ):
            setup.hook.crossgrad_run_start(run=self._info())
            self._catch_up()
            state, guard = self.state, RollbackGuard(self.state)
            while True:
                ended = train(self.setup, state, self.session, self.stopper, length.due, guard)
                if ended != "paused":
                    self.ending = Ending(ended)
                    return
                revised = length.revised(self.setup, state)
                if revised is not self.setup:
                    # Copy the state, so that a later rollback cannot return to a step before the
                    # change of length.
                    guard.copy(state)
                # Write the file only if the planned length has changed.
                if revised.config is not self.setup.config:
                    folder = self.session.folder
                    write_config(folder, revised.config, read_notes(folder))
                self.setup = revised

    def _edit_finished(self) -> None:
        state = self.state
        state.laps = PhaseTimer()
        self._unless_interrupted(self._apply_final_edits)
        state.laps.lap("density_control")
        state.clock.count(state.laps)

    def _apply_final_edits(self) -> None:
        for edit in final_edits(self.setup, self.state):
            self.session.renew(self.setup, self.state.step)
            self.setup.hook.crossgrad_log(text=edit.note)

    def _catch_up(self) -> None:
        """Evaluate the state if an earlier session ended before the evaluation of its last step."""
        setup, state, session = self.setup, self.state, self.session
        if evaluates_after(setup, state.step) and not session.has_row(state.step):
            session.evaluate(setup, state)

    def _describe(self) -> None:
        setup, state, session = self.setup, self.state, self.session
        parts: tuple[tuple[str, Callable[[], None]], ...] = (
            ("no evaluation", lambda: session.evaluate(setup, state, panels=PANELS)),
            ("no per_view.csv", lambda: session.write_views(state)),
            ("no curve.png", lambda: session.draw(setup, state)),
            ("no point_cloud.ply", lambda: session.export(setup, state)),
            (f"no {PAGE}", lambda: session.write_page(setup, state)),
        )
        for missing, write in parts:
            self._attempt(missing, partial(self._unless_interrupted, write))

    def _unless_interrupted(self, action: Callable[[], _T]) -> _T:
        with self.stopper.interruptible():
            if self.stopper.at_once:
                raise KeyboardInterrupt
            try:
                return action()
            except Exception as error:
                # Compiled code may raise its own exception instead of `KeyboardInterrupt`.
                if self.stopper.at_once:
                    raise KeyboardInterrupt from error
                raise

    def _summarise(self) -> None:
        ending = self.ending
        self._attempt(
            "no summary.json",
            lambda: self.session.summarise(self.setup, self.state, ending.status, ending.error),
        )

    def _attempt(self, missing: str, action: Callable[[], None]) -> None:
        """Execute a part of the run; record a failure of the part in the ending.

        Args:
            missing: The result that is missing if the part fails.
            action: The function that executes the part.
        """
        try:
            action()
        except KeyboardInterrupt:
            if self.ending.error is None:
                self.ending = replace(self.ending, status="stopped")
        except (Exception, SystemExit) as error:  # Third-party code may raise any exception.
            self._note(error, missing)

    def _note(self, error: BaseException, missing: str) -> None:
        reason, traced = reason_of(error), is_unexpected(error)
        if traced:
            self.log.write(traceback_of(error))
        message = self.ending.error
        if message is None or reason not in message:
            parts = [
                message,
                ": ".join(part for part in (missing, *notes_on(error), reason) if part),
            ]
            message = "\n".join(part for part in parts if part)
        before = self.ending
        self.ending = Ending("failed", message, before.traced or traced, before.cause or error)

    def _info(self) -> RunInfo:
        setup = self.setup
        return RunInfo(
            folder=self.session.folder,
            scene=setup.scene,
            config=setup.config.model_dump(mode="json"),
            schedule=setup.schedule,
            blocks=setup.blocks,
            notes=setup.notes,
            decisions=setup.decisions,
        )


def exit_messages(course: RunLoop) -> list[str]:
    """Return messages about a failed, empty or unfinished run, and the command to continue it."""
    ending, folder = course.ending, course.session.folder
    lines = []
    if not course.state.primitives(course.setup):
        name = course.setup.selection.names["densifier"]
        lines.append(f"no Gaussian is left: check densifier {name} and the photos")
    if ending.error is not None:
        lines += f"training failed: {ending.error}".splitlines()
    if course.session.gone:
        return lines
    if ending.traced:
        lines.append(f"{one_line(folder / LOG)} contains the traceback")
    lines += _kept(course)
    if ending.status == "finished":
        return [*lines, *overdone(read_metrics(folder))]
    return [*lines, resume_line(folder)]


def overdone(rows: Sequence[Row]) -> list[str]:
    """Return a line if a run ended more than `WORSE` decibels below its best evaluation."""
    best, last = best_of(rows), rows[-1].get("psnr") if rows else None
    if best is None or last is None or not best["psnr"] - last > WORSE:
        return []
    gap, step = best["psnr"] - last, best["step"]
    return [
        (
            f"the last evaluation is {gap:.2f} dB lower than at step {step:.0f} "
            f"({best['psnr']:.2f} dB after {best['train_seconds']:,.0f} s of training): "
            "a shorter run may be sufficient (--max-views N)"
        )
    ]


def next_lines(folder: Path) -> list[str]:
    """Return the commands that show and export the results of a finished run, and its page."""
    run = one_line(quote(str(folder)))
    lines = [f"next: crossgrad view {run} (in a browser), crossgrad export {run} (more formats)"]
    if (folder / PAGE).is_file():
        lines.append(f"open the scene in a browser: {one_line(folder / PAGE)}")
    return lines


def resume_line(folder: Path) -> str:
    """Return the command that continues a run."""
    return f"continue with: crossgrad run --resume {one_line(quote(str(folder)))}"


def _kept(course: RunLoop) -> list[str]:
    """Return a line about the last step if no checkpoint contains the state after this step."""
    step = course.state.step
    saved = max(named_checkpoints(course.session.folder / CHECKPOINTS), default=0)
    if saved >= step:
        return []
    there = f"the latest checkpoint is from step {saved}" if saved else "there is no checkpoint"
    return [f"the state of step {step} could not be saved; {there}"]


#: Number of steps and of training seconds that are measured before the remaining time is estimated.
#: The first step of a session is not measured.
LOOK_STEPS, LOOK_SECONDS = 3, 2.0
#: Shortest remaining time for which an estimate is shown, in seconds.
WORTH_A_LINE = 60.0


class Forecast:
    """A wrapper of a `Length` that logs once how long the remaining steps will take.

    Args:
        length: The rule for the number of steps of the run.
    """

    def __init__(self, length: Length) -> None:
        self._length = length
        self._first: tuple[int, float] | None = None
        self._told = False

    def due(self, state: TrainState) -> bool:
        """Return True if `revised` has to decide the length or to log the estimate."""
        if self._first is None:
            self._first = state.step, state.clock.train
        return self._length.due(state) or self._is_time(state)

    def revised(self, setup: Setup, state: TrainState) -> Setup:
        """Return the setup with the present length, and log the estimate if it is due."""
        if self._length.due(state):
            setup = self._length.revised(setup, state)
        if self._is_time(state):
            self._tell(setup, state)
        return setup

    def _is_time(self, state: TrainState) -> bool:
        if self._told or self._first is None:
            return False
        step, seconds = self._first
        return state.step - step >= LOOK_STEPS and state.clock.train - seconds >= LOOK_SECONDS

    def _tell(self, setup: Setup, state: TrainState) -> None:
        self._told = True
        step, seconds = self._first or (0, 0.0)
        seconds_per_step = (state.clock.train - seconds) / (state.step - step)
        ahead = seconds_ahead(setup, state, seconds_per_step)
        if ahead < WORTH_A_LINE:
            return
        left = setup.schedule.total - state.step
        growth = ", including growth" if ahead > left * seconds_per_step else ""
        setup.hook.crossgrad_log(
            text=f"the remaining {left:,} steps take {roughly(ahead)} (one step takes "
            f"{seconds_per_step * 1000:.0f} ms now{growth}); --seconds S sets a time limit "
            "instead, and Ctrl-C stops the run and keeps the results so far"
        )

"""A run from its settings to its results, for new and for resumed runs."""

import logging
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from time import perf_counter
from typing import Any, cast

import numba
import numpy as np
import torch

from crossgrad_core.config import AUTO, ComponentChoice, RunConfig
from crossgrad_core.contract.slots.observer import Observer
from crossgrad_core.defaults import PREPARING_READER
from crossgrad_core.errors import UserError
from crossgrad_core.recipe.table import open_again, short_lines
from crossgrad_core.registry.entries import failed_plugin, notes_on
from crossgrad_core.run.decisions import redecided
from crossgrad_core.run.finish import (
    Ending,
    Forecast,
    RunLoop,
    exit_messages,
    next_lines,
    reason_of,
    resume_line,
)
from crossgrad_core.run.load_run import Displays, continued, progress_at, set_up
from crossgrad_core.run.resolve import resolved
from crossgrad_core.run.results.config_file import FILE as CONFIG
from crossgrad_core.run.results.config_file import as_yaml, read_config, write_config
from crossgrad_core.run.results.folder import (
    RUNS,
    SMALLEST_NEED,
    RunName,
    check_out,
    clear_half_written,
    create_run_folder,
    expected_bytes,
)
from crossgrad_core.run.results.lock import locked
from crossgrad_core.run.results.log import RunLog
from crossgrad_core.run.results.metrics_csv import PER_VIEW
from crossgrad_core.run.results.plugins_file import (
    packages_of,
    read_plugins,
    with_present,
    write_plugins,
)
from crossgrad_core.run.results.scene_file import write_scene
from crossgrad_core.run.results.summary import final_table, summarised_step
from crossgrad_core.run.session import Session, cloud_name, totals
from crossgrad_core.run.settings import layered, parsed, with_recipe
from crossgrad_core.run.unused_settings import (
    refuse_labels_for_nothing,
    refuse_settings_for_nothing,
    without_resets,
)
from crossgrad_core.scene.fingerprint import fingerprint_of
from crossgrad_core.scene.photos.photos_ahead import check_photos, fits
from crossgrad_core.system.check_writable import check_folder
from crossgrad_core.system.checksums import changed_files, drop_checksums
from crossgrad_core.system.interrupts import exit_code, resume_hint
from crossgrad_core.training.budget import Length, Planned, Timed, most_steps, steps_for
from crossgrad_core.training.loop import Stopper
from crossgrad_core.training.per_image_params import known_starts
from crossgrad_core.training.schedules import notes_on_length, schedule_of
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.start import first_state, initial_bytes, start_notes, warm_up
from crossgrad_core.training.state import NonFiniteError, TrainingFailedError, TrainState
from crossgrad_core.training.step import check_largest_draw
from crossgrad_core.wording import listed, one_line


def check_clock(config: RunConfig) -> None:
    """Refuse a time budget in CPU seconds on several threads or on a GPU.

    Call this function after the number of threads is set.

    Raises:
        UserError: CPU time would count waiting threads, or would miss the work of the GPU.
    """
    if config.seconds is None or config.clock == "wall":
        return
    if config.device != AUTO and torch.device(config.device).type != "cpu":
        raise UserError(
            "CPU time does not include the time of a GPU",
            where="--clock cpu",
            expected="--device cpu",
            found=f"--device {config.device}",
            todo="leave --clock out",
        )
    threads = torch.get_num_threads()
    if threads > 1:
        raise UserError(
            "CPU time would include threads that only wait for other threads",
            where="--clock cpu",
            expected="one thread",
            found=f"{threads} threads",
            todo="add --threads 1, or leave --clock out",
        )


#: Length of a run on the bundled scene if the user sets no length. The run ends after this many
#: training seconds, or after 100 views of each training photo, because more views overfit
#: (docs/few-photos.md).
BUNDLED_SECONDS = 120.0


def bundled_scene() -> Path:
    """Return the folder of the bundled scene, in an installed package or in a checkout.

    Raises:
        UserError: Both folders are missing.
    """
    package = Path(__file__).resolve().parents[1]
    installed = package / "data" / "boruszyn"
    checkout = package.parent / "examples" / "scenes" / "boruszyn"
    for folder in (installed, checkout):
        if folder.is_dir():
            return folder
    raise UserError(
        "the bundled scene is missing",
        where=installed,
        todo="name a scene: crossgrad run SCENE",
    )


_LOG = logging.getLogger(__name__)
#: Exit code of a failed run. The results that the run wrote before the failure are kept.
FAILED = 1


@dataclass(frozen=True)
class Outcome:
    """The outcome of a run.

    Attributes:
        folder: The folder of the results.
        ending: The status and, after a failure, the reason.
        signal: Number of the signal that stopped the run; None if there was no signal.
    """

    folder: Path
    ending: Ending
    signal: int | None

    @property
    def exit_code(self) -> int:
        """The exit code: 0; 1 if training failed; 128 plus the signal's number after a signal."""
        if self.ending.status == "failed":
            return FAILED
        return 0 if self.signal is None else exit_code(self.signal)


#: Function that receives the results (table, folder and exit messages). A run calls this function
#: while signals are recorded but do not end the process.
Tell = Callable[[str, Path, Sequence[str]], None]


def run(  # noqa: PLR0913 - one parameter per option of the command line
    settings: Mapping[str, Any],
    *,
    resume: Path | None = None,
    dry_run: bool = False,
    verbosity: int = 0,
    accept_scene: bool = False,
    accept_plugins: bool = False,
    check: bool = False,
    viewer: ComponentChoice | None = None,
) -> int:
    """Train, evaluate, export, and print the results, as `crossgrad run` does.

    Args:
        settings: The user's settings, in the shape of `RunConfig`.
        resume: Folder of a stopped run to continue.
        dry_run: For a new run: check everything, print the resolved settings, train nothing.
        verbosity: -1 quiet, 0 normal, 1 verbose.
        accept_scene: For a new run: train although points, poses and photos do not match. For a
            resumed run: continue although photos, masks or points of the scene have changed.
        accept_plugins: Continue with other versions of the packages that train the run.
        check: Decode all photos before training.
        viewer: The observer of `--view`.

    Returns:
        The exit code: 0; 1 if training failed; 128 plus the signal's number if a signal stopped the
        run (130 for an interrupt by the user).

    Raises:
        UserError: The input is invalid; nothing was written.
    """
    way = Way(verbosity, _print_results, check, viewer)
    if resume is not None:
        accepted = {"accept_scene": accept_scene, "accept_plugins": accept_plugins}
        return _end(resumed(resume, settings, way, **accepted), way)
    if accept_plugins:
        raise UserError(
            "--accept-plugins has no effect on a new run",
            where="--accept-plugins",
            todo="leave --accept-plugins out, or name a run to resume with --resume",
        )
    if accept_scene:
        settings = layered([settings, {"data.accept_scene": True}])
    if dry_run:
        _print_dry_run(_with_remarks(_checked(settings, way)[0])[0])
        return 0
    return _end(new(settings, way), way)


def _end(outcome: "Outcome", way: "Way") -> int:
    """Print commands that the user may run next after a finished run; return the exit code."""
    if outcome.ending.status == "finished" and way.verbosity >= 0 and outcome.folder.is_dir():
        print("\n".join(next_lines(outcome.folder)))  # noqa: T201
    return outcome.exit_code


@dataclass(frozen=True)
class Way:
    """The form in which a run reports to the user.

    Attributes:
        verbosity: -1 quiet, 0 normal, 1 verbose.
        tell: Function that receives the results.
        check: True to decode all photos before training, False for the held-out photos only.
        viewer: The observer of `--view`.
    """

    verbosity: int
    tell: Tell
    check: bool = False
    viewer: ComponentChoice | None = None

    @property
    def displays(self) -> Displays:
        """The observers that show the run to the user."""
        progress = progress_at(self.verbosity)
        return (progress,) if self.viewer is None else (progress, self.viewer)


def new(settings: Mapping[str, Any], way: Way) -> Outcome:
    """Train a new run, evaluate and export it.

    Raises:
        UserError: The input is invalid; nothing was written.
    """
    setup, load_seconds = _checked(settings, way)
    config = setup.config
    check_folder(config.out or RUNS, expected_bytes(len(setup.scene.points), 2))
    length: Length = Forecast(Planned(config.revisions))
    with _tried_out():
        compile_seconds = warm_up(setup)
        if config.seconds is not None:
            length = Timed(config.seconds, config.clock, most=most_steps(setup))
            setup = _within(setup, config.seconds)
    setup, remark_seconds = _with_remarks(setup)
    state = first_state(setup)
    if setup.config.max_gaussians == AUTO:
        setup = redecided(setup, setup.schedule.total, state.primitives(setup))
    setup = replace(setup, notes=(*setup.notes, *start_notes(setup, state)))
    state.clock.load, state.clock.compile = load_seconds + remark_seconds, compile_seconds
    with _new_folder(setup, state) as folder:
        setup = replace(setup, config=resolved(setup))
        write_config(folder, setup.config, setup.notes)
        write_plugins(folder, packages_of(setup))
        write_scene(folder, fingerprint_of(setup.scene, cast("Path", setup.config.scene)))
        with resume_hint(resume_line(folder)):
            return _train(setup, state, Session.fresh(folder, setup), length, way.tell)


def _with_remarks(setup: Setup) -> tuple[Setup, float]:
    """Return the setup with messages of exposure and initializer, and the time for the messages."""
    begun, scene = perf_counter(), setup.scene
    messages = setup.exposure.messages(scene, known_starts(setup))
    messages += setup.selection.initializer.messages(scene)
    return replace(setup, notes=(*setup.notes, *messages)), perf_counter() - begun


def _checked(settings: Mapping[str, Any], way: Way) -> tuple[Setup, float]:
    """Return the setup of a new run after all checks, and the seconds that loading took."""
    config = with_defaults(parsed(with_recipe(settings)))
    check_out(config.out)
    check_folder(config.out or RUNS, SMALLEST_NEED)
    setup, load_seconds = set_up(config, way.displays)
    check_clock(config)
    refuse_labels_for_nothing(setup)
    refuse_settings_for_nothing(open_again(config), setup)
    known_starts(setup)
    check_largest_draw(setup)
    _check_observers(setup)
    return setup, load_seconds + _decoded(setup, way)


def _check_observers(setup: Setup) -> None:
    """Refuse a run whose observers cannot work on this machine.

    Raises:
        UserError: See `Observer.check`.
    """
    for plugin in setup.plugins.values():
        if isinstance(plugin, Observer):
            plugin.check()


def with_defaults(config: RunConfig) -> RunConfig:
    """Return the configuration with the bundled scene and its length if the user names no scene."""
    lengths = {"steps": config.steps, "views": config.max_views, "seconds": config.seconds}
    given = {unit: length for unit, length in lengths.items() if length is not None}
    if "steps" in given and len(given) > 1:
        raise UserError(
            "more than one length of the run was given; a run has a length in steps, in "
            "views or in seconds, or in views with a limit in seconds",
            where="--steps, --max-views, --seconds",
            found=listed(f"{length:g} {unit}" for unit, length in given.items()),
            todo="leave --steps out, or give only --steps",
        )
    if config.scene is None and config.reader.name == PREPARING_READER:
        raise UserError(
            "--prepare needs a folder of photos",
            where="--prepare",
            expected="a folder of photos",
            found="no SCENE; the bundled scene is used and needs no preparation",
            todo="name the folder: crossgrad run PHOTOS --prepare",
        )
    if config.scene is None:
        config = config.model_copy(update={"scene": bundled_scene()})
        if not given:
            config = config.model_copy(update={"seconds": BUNDLED_SECONDS})
    return config


@contextmanager
def _tried_out() -> Iterator[None]:
    """Convert an error in a trial step to a user error.

    Trial steps compile kernels and measure the time per step, before any file is written.
    """
    try:
        yield
    # Numerical or memory problems can cause errors of these types, so convert them to user errors.
    # Any other error is a bug of crossgrad, so keep its traceback.
    except (TrainingFailedError, NonFiniteError, RuntimeError, ValueError, MemoryError) as error:
        if isinstance(error, UserError) or failed_plugin(error):
            raise
        raise UserError(
            "a trial step failed before the training started",
            found=": ".join([*notes_on(error), reason_of(error)]),
            todo="check the settings, such as --rate-factor and --loss, and the photos",
        ) from error


def _within(setup: Setup, seconds: float) -> Setup:
    """Return the setup with the number of steps that fits into `seconds` of training."""
    steps, note, share = steps_for(setup, seconds)
    update = {"steps": steps, "seconds": None, "max_views": None, "revisions": ()}
    given = {"planned_seconds": seconds, "planned_views": setup.config.max_views}
    config = setup.config.model_copy(update={**update, **given})
    setup = redecided(replace(setup, config=config, pixel_share=share), steps)
    schedule = schedule_of(setup.config, setup.densifier, steps, setup.schedule.counting)
    setup = replace(setup, schedule=schedule)
    idle = [f"{name} has no effect: {why}" for name, why in without_resets(config, setup)]
    new_notes = (
        note,
        *notes_on_length(setup),
        *idle,
    )
    return replace(setup, notes=(*setup.notes, *new_notes))


@contextmanager
def _new_folder(setup: Setup, state: TrainState) -> Iterator[Path]:
    """Yield a new folder for a run, locked against other processes."""
    names = setup.selection.names
    name = RunName(
        setup.scene.name,
        names["backbone"],
        names["sampler"],
        names["operator"],
        datetime.now().astimezone(),
    )
    needed = expected_bytes(state.primitives(setup), 2)
    folder = create_run_folder(name, setup.config.out, needed=needed)
    with _held(folder):
        # Check again after taking the lock, because another run may have written to the folder
        # before the lock.
        check_out(folder)
        yield folder


@contextmanager
def _held(folder: Path) -> Iterator[None]:
    with locked(folder, "training") as held:
        if not held:
            _LOG.warning(
                "the file system of %s does not support locks, so a second process could write to "
                "the same folder",
                folder,
            )
        clear_half_written(folder)
        yield


def _train(
    setup: Setup, state: TrainState, session: Session, length: Length, tell: Tell
) -> Outcome:
    """Train from `state` on, and complete the run's folder even after a failure."""
    log = RunLog(session.folder)
    setup.manager.register(log, name="log")
    setup.manager.register(session.machine, name="machine")
    stopper = Stopper()
    with stopper.installed():
        course = RunLoop(setup, state, session, log, stopper)
        ending = course.to_the_end(length)
        table = final_table(session.result(state.step), totals(course.setup, state))
        words = exit_messages(course)
        for text in (table, *words):
            log.write(text)
        tell(table, session.folder, words)
    return Outcome(session.folder, ending, stopper.signal)


def _print_results(table: str, folder: Path, words: Sequence[str]) -> None:
    print(table)  # noqa: T201 - print the result of the command
    if folder.is_dir():  # Print the folder only if nobody moved it.
        print(f"results in {one_line(folder)}")  # noqa: T201
    for line in words:
        print(line, file=sys.stderr)  # noqa: T201


def resumed(
    folder: Path,
    settings: Mapping[str, Any],
    way: Way,
    *,
    accept_scene: bool = False,
    accept_plugins: bool = False,
) -> Outcome:
    """Continue a run.

    Args:
        folder: The run's folder.
        settings: Only `device`, `threads` and `stop_after` may differ from the run's own settings.
        way: The form in which the run reports to the user.
        accept_scene: Continue although photos, masks or points of the scene have changed.
        accept_plugins: Continue with other versions of the packages that train the run.

    Raises:
        UserError: The folder is not a run, the run is finished or in use, a setting would change
            the training, or the scene or a package has changed.
    """
    accepted = {"accept_scene": accept_scene, "accept_plugins": accept_plugins}
    # Check the folder before taking the lock, because the lock would change a folder that is not a
    # run.
    read_config(folder)
    with resume_hint(resume_line(folder)), _held(folder):
        setup, state = continued(folder, settings, way.displays, **accepted)
        step, total = state.step, setup.schedule.total
        done = step >= total and summarised_step(folder, "finished") == step
        files = PER_VIEW, cloud_name(setup.selection.exporter)
        # Leave out the configuration file, because its settings are compared separately.
        damaged = set(changed_files(folder)) - {CONFIG}
        if done and not damaged and all((folder / name).exists() for name in files):
            raise UserError(
                "the run is finished, so that it cannot be resumed",
                where=folder,
                found=f"all {total} steps done",
                todo=f"start a new run; --init {folder / files[1]} starts from its Gaussians",
            )
        stop, follows_clock = setup.config.stop_after, setup.config.planned_seconds is not None
        if stop is not None and (stop <= step or (stop > total and not follows_clock)):
            raise UserError(
                "--stop-after names a step that the run has already passed"
                if stop <= step
                else "--stop-after names a step after the end of the run",
                where="--stop-after",
                expected=f"a step from {step + 1} to {total}",
                found=str(stop),
                todo="name a step in this range, or leave --stop-after out to train to the end",
            )
        _check_observers(setup)
        if step < total:
            state.clock.load += _decoded(setup, way)
            with _tried_out():
                state.clock.compile += warm_up(setup, state)
        drop_checksums(folder)
        write_scene(folder, fingerprint_of(setup.scene, cast("Path", setup.config.scene)))
        recorded = read_plugins(folder, quiet=True) if step else None
        write_plugins(folder, with_present(recorded, packages_of(setup)))
        session = Session.resumed(folder, setup, step)
        length = Forecast(Planned(setup.config.revisions))
        return _train(setup, state, session, length, way.tell)


def _decoded(setup: Setup, way: Way) -> float:
    """Check that the held-out photos, or all photos, can be decoded; return the time in seconds."""
    start = perf_counter()
    keep = fits(setup.scene, setup.config.data.cache_mib)
    views = setup.scene.views if way.check else setup.scene.test_views
    check_photos(views, keep=keep, whole=way.check)
    return perf_counter() - start


def _print_dry_run(setup: Setup) -> None:
    print(as_yaml(resolved(setup)), end="")  # noqa: T201
    for note in (*short_lines(setup.decisions), *setup.notes):
        print(f"# {note}")  # noqa: T201
    memory = initial_bytes(setup) / 2**20
    print(f"# the run would train; parameters and optimizer start at {memory:.0f} MiB")  # noqa: T201


@contextmanager
def as_in_a_command() -> Iterator[None]:
    """Use the default global settings of torch and numpy inside the block.

    The caller's default type, default device, `no_grad`, `inference_mode`, `np.errstate` or number
    of threads would change the results of a run or make the run fail. After the block, the caller's
    settings are restored.
    """
    threads = torch.get_num_threads(), numba.get_num_threads()
    kind, device = torch.get_default_dtype(), torch.get_default_device()
    torch.set_default_dtype(torch.float32)
    _set_device(device, torch.device("cpu"))
    try:
        with (
            torch.inference_mode(mode=False),
            torch.enable_grad(),
            np.errstate(divide="warn", over="warn", under="ignore", invalid="warn"),
        ):
            yield
    finally:
        torch.set_default_dtype(kind)
        _set_device(torch.device("cpu"), device)
        torch.set_num_threads(threads[0])
        numba.set_num_threads(threads[1])


def _set_device(old: torch.device, new: torch.device) -> None:
    """Set the default device only if it changes, because a default device slows down every call."""
    if old != new:
        torch.set_default_device(new)

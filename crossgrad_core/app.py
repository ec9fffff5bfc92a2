"""What the commands do: run, resume, evaluate, render, export."""

import logging
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from time import perf_counter
from typing import Any, cast

from pydantic import ValidationError

from crossgrad_core.checkpoint import load_latest
from crossgrad_core.config import ComponentChoice, RunConfig
from crossgrad_core.errors import UserError
from crossgrad_core.files import clear_leftovers
from crossgrad_core.results.config_file import as_yaml, read_config, write_config
from crossgrad_core.results.folder import RunName, check_out, create_run_folder, expected_bytes
from crossgrad_core.results.lock import locked
from crossgrad_core.results.log import RunLog
from crossgrad_core.results.summary import read_summary
from crossgrad_core.results.table import final_table
from crossgrad_core.threads import configure_threads
from crossgrad_core.training.assemble import (
    DEFAULT_STEPS,
    assemble,
    check_names,
    growth_note,
    read_scene,
    schedule_of,
)
from crossgrad_core.training.budget import Length, Planned, Timed, caught_up, steps_for
from crossgrad_core.training.bundled import BUNDLED_SECONDS, bundled_scene
from crossgrad_core.training.ending import Course, last_words
from crossgrad_core.training.export import described, export_ply, renderer
from crossgrad_core.training.forecast import Forecast
from crossgrad_core.training.persist import from_checkpoint
from crossgrad_core.training.resolve import resolved
from crossgrad_core.training.session import Session, totals
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.start import first_state, initial_bytes, warm_up
from crossgrad_core.training.state import TrainState
from crossgrad_core.training.stopper import Stopper
from crossgrad_core.validation import as_user_error

_LOG = logging.getLogger(__name__)
#: Exit code of a run that failed; what it has is kept.
FAILED = 1
#: A run that a signal stopped ends with this plus the signal's number, as shells expect: 130 after
#: Ctrl-C, 143 after SIGTERM.
BY_SIGNAL = 128


def run(
    settings: Mapping[str, Any],
    *,
    resume: Path | None = None,
    dry_run: bool = False,
    verbosity: int = 0,
) -> int:
    """Trains, evaluates and exports.

    Args:
        settings: What the user set, in the shape of `RunConfig`.
        resume: Folder of a stopped run to continue.
        dry_run: Check everything, print the resolved settings, train nothing.
        verbosity: -1 quiet, 0 normal, 1 verbose.

    Returns:
        The exit code: 0, 1 where training failed, 130 where the user interrupted the run (128 and
        the number of the signal).

    Raises:
        UserError: The input is bad; nothing was written.
    """
    if resume is not None:
        return _resume(resume, settings, verbosity)
    config = with_defaults(parsed(settings))
    check_out(config.out)
    setup, load_seconds = _setup(config, verbosity)
    if dry_run:
        _print_dry_run(setup)
        return 0
    compile_seconds = warm_up(setup)
    length: Length = Forecast(Planned(config.revisions))
    if config.seconds is not None:
        setup = _within(setup, config.seconds)
        length = Timed(config.seconds)
    setup = replace(setup, notes=(*setup.notes, *growth_note(setup)))
    state = first_state(setup)
    state.clock.load, state.clock.compile = load_seconds, compile_seconds
    with _new_folder(setup, state) as folder:
        setup = replace(setup, config=resolved(setup))
        write_config(folder, setup.config)
        return _train(setup, state, Session.fresh(folder, setup), length)


def parsed(settings: Mapping[str, Any]) -> RunConfig:
    """The validated configuration.

    Raises:
        UserError: A setting does not exist or has a wrong value.
    """
    try:
        return RunConfig.model_validate(settings)
    except ValidationError as error:
        raise as_user_error(
            error, RunConfig, subject="a run", todo="crossgrad run --help lists every setting"
        ) from error


def with_defaults(config: RunConfig) -> RunConfig:
    """The configuration with scene and length filled in."""
    if config.steps is not None and config.seconds is not None:
        raise UserError(
            "a run has either a number of steps or of seconds",
            where="--steps, --seconds",
            found=f"{config.steps} steps and {config.seconds:g} seconds",
            todo="leave one of them out",
        )
    if config.scene is None:
        config = config.model_copy(update={"scene": bundled_scene()})
        if config.steps is None and config.seconds is None:
            config = config.model_copy(update={"seconds": BUNDLED_SECONDS})
    elif config.steps is None and config.seconds is None:
        config = config.model_copy(update={"steps": DEFAULT_STEPS})
    return config


def _setup(config: RunConfig, verbosity: int) -> tuple[Setup, float]:
    """The assembled run and the seconds that reading the scene took."""
    check_names(config)
    configure_threads(config.threads)
    start = perf_counter()
    scene, reader = read_scene(config, cast("Path", config.scene))
    seconds = perf_counter() - start
    level = {-1: "quiet", 0: "normal", 1: "verbose"}[verbosity]
    if not any(choice.name == "progress" for choice in config.observers):
        progress = ComponentChoice.model_validate({"name": "progress", "level": level})
        config = config.model_copy(update={"observers": (*config.observers, progress)})
    return assemble(config, scene, reader), seconds


def _within(setup: Setup, seconds: float) -> Setup:
    """The setup with the length that fits into `seconds` of training."""
    steps, note = steps_for(setup, seconds)
    update = {"steps": steps, "seconds": None, "revisions": ()}
    config = setup.config.model_copy(update=update)
    schedule = schedule_of(config, setup.densifier, steps)
    return replace(setup, config=config, schedule=schedule, notes=(*setup.notes, note))


@contextmanager
def _new_folder(setup: Setup, state: TrainState) -> Iterator[Path]:
    """A folder for a new run, which nobody else writes into meanwhile."""
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
        # Another run may have begun and ended here meanwhile.
        check_out(folder)
        yield folder


@contextmanager
def _held(folder: Path) -> Iterator[None]:
    with locked(folder, "training") as held:
        if not held:
            _LOG.warning(
                "the file system of %s has no locks; nothing keeps a second process from writing "
                "into it",
                folder,
            )
        clear_leftovers(folder)
        yield


def _train(setup: Setup, state: TrainState, session: Session, length: Length) -> int:
    """Trains from `state` on and finishes the run's folder whatever happens."""
    log = RunLog(session.folder)
    setup.manager.register(log, name="log")
    stopper = Stopper()
    with stopper.installed():
        course = Course(setup, state, session, log, stopper)
        ending = course.to_the_end(length)
        table = final_table(session.result(state.step), totals(course.setup, state))
        log.write(table)
        print(table)  # noqa: T201 - the result of the command
        print(f"results in {session.folder}")  # noqa: T201
        for line in last_words(course):
            log.write(line)
            print(line, file=sys.stderr)  # noqa: T201
    if ending.status == "failed":
        return FAILED
    return 0 if stopper.signal is None else BY_SIGNAL + stopper.signal


def _resume(folder: Path, settings: Mapping[str, Any], verbosity: int) -> int:
    read_config(folder)  # Before a lock is laid into a folder that is no run's.
    with _held(folder):
        setup, state = opened(folder, settings, verbosity)
        if state.step >= setup.schedule.total and _is_described(folder, state.step):
            raise UserError(
                "the run is finished",
                where=folder,
                found=f"all {setup.schedule.total} steps done",
                todo="start a new run; --init point_cloud.ply starts from its Gaussians",
            )
        if state.step < setup.schedule.total:
            state.clock.compile += warm_up(setup, state)
        session = Session.resumed(folder, setup, state.step)
        return _train(setup, state, session, Forecast(Planned(setup.config.revisions)))


def _is_described(folder: Path, step: int) -> bool:
    """Whether nothing is missing of a run that did all its steps, `step` in number."""
    try:
        summary = read_summary(folder)
    except UserError:
        return False
    return summary.get("status") == "finished" and summary.get("step") == step


def opened(
    folder: Path, settings: Mapping[str, Any], verbosity: int = 0
) -> tuple[Setup, TrainState]:
    """A run's setup and its newest state.

    Args:
        folder: The run's folder.
        settings: Only `device`, `threads` and `stop_after` may differ from the run's own.
        verbosity: -1 quiet, 0 normal, 1 verbose.

    Raises:
        UserError: It is no run, it has no checkpoint, or a setting would change the training.
    """
    stored = read_config(folder)
    checkpoint = load_latest(folder)
    frozen = sorted(set(settings) - {"device", "threads", "stop_after"})
    if frozen:
        raise UserError(
            "a resumed run keeps its settings",
            where=", ".join(f"--{name.replace('_', '-')}" for name in frozen),
            todo="leave them out, or start a new run",
        )
    stored.pop("stop_after", None)
    # The degree that a run started with is written down; where it is not, it was 0.
    stored["sh_from"] = stored.get("sh_from") or 0
    config = parsed({**stored, **settings})
    setup, seconds = _setup(config, verbosity)
    state = from_checkpoint(setup, checkpoint)
    setup = caught_up(setup, state.step)
    state.clock.load += seconds
    return setup, state


def evaluate(folder: Path, *, device: str | None = None, threads: int | None = None) -> None:
    """Evaluates the held-out views of a run again; prints the table and renews per_view.csv.

    Raises:
        UserError: It is no run, or it has no checkpoint.
    """
    from crossgrad_core.evaluation import evaluate as measured
    from crossgrad_core.results.per_view import write_per_view

    setup, state = opened(folder, _machine(device, threads), -1)
    result = measured(setup.scene.test_views, renderer(setup, state))
    write_per_view(folder, result)
    print(final_table(result, totals(setup, state)))  # noqa: T201


def render(folder: Path, *, split: str, out: Path | None, device: str | None = None) -> None:
    """Draws photo | render | error of the views of a run.

    Raises:
        UserError: It is no run, it has no checkpoint, or the split is empty.
    """
    from crossgrad_core.evaluation import evaluate as measured
    from crossgrad_core.results.panels import PanelWriter

    setup, state = opened(folder, _machine(device, None), -1)
    scene = setup.scene
    views = {"test": scene.test_views, "train": scene.train_views, "all": scene.views}[split]
    if not views:
        raise UserError(
            "there are no views to render",
            where=f"--split {split}",
            todo="choose another --split: train, test or all",
        )
    writer = PanelWriter.of(folder, state.step, views, len(views))
    if out is not None:
        writer = replace(writer, folder=out)
    measured(views, renderer(setup, state), on_view=writer.write)
    print(f"{len(views)} panels in {writer.folder}")  # noqa: T201


def export(folder: Path, *, file_format: str, out: Path | None, camera: str | None = None) -> None:
    """Writes the trained scene to a file that viewers open.

    Args:
        folder: The run's folder.
        file_format: `ply`.
        out: The file; by default `point_cloud.ply` in the run's folder.
        camera: Name of the view to bake for; by default the average over the training views.

    Raises:
        UserError: It is no run, it has no checkpoint, the file exists, or there is no such view.
    """
    path = out or folder / f"point_cloud.{file_format}"
    if out is not None and out.exists():
        raise UserError("the file exists", where=out, todo="choose another --out, or remove it")
    setup, state = opened(folder, {}, -1)
    exported = export_ply(setup, state, path, camera)
    for line in described(exported, path):
        print(line)  # noqa: T201
    print(f"{exported.gaussians:,} Gaussians in {path}")  # noqa: T201


def _machine(device: str | None, threads: int | None) -> dict[str, Any]:
    given = {"device": device, "threads": threads}
    return {name: value for name, value in given.items() if value is not None}


def _print_dry_run(setup: Setup) -> None:
    print(as_yaml(resolved(setup)), end="")  # noqa: T201
    for note in setup.notes:
        print(f"# {note}")  # noqa: T201
    memory = initial_bytes(setup) / 2**20
    print(f"# would train; parameters and optimizer start at {memory:.0f} MiB")  # noqa: T201

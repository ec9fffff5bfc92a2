"""Runs from Python: what `crossgrad run` does, with exceptions instead of exit codes."""

import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from crossgrad_core.errors import RunFailedError
from crossgrad_core.run import app
from crossgrad_core.run.app import as_in_a_command
from crossgrad_core.run.settings import merged
from crossgrad_core.run.trained import Run
from crossgrad_core.system.startup import announce, finish


def run(
    scene: Path | str | None = None,
    *,
    config: Path | str | None = None,
    quiet: bool = False,
    verbose: bool = False,
    **options: object,
) -> Run:
    """Trains a scene, evaluates and exports it, into the same folder as `crossgrad run`.

    Args:
        scene: Scene folder; the bundled example scene by default.
        config: YAML file with settings, such as the config.yaml of a run; options win over it.
        quiet: Shows no progress.
        verbose: Shows every decision and event.
        options: What the options of `crossgrad run` and the keys of config.yaml are called:
            `backbone="scaffold"`, `seconds=60`, `max_size=800`, `out="runs/mine"`. A component's
            own options go with its name, `operator={"name": "cagrad", "c": 0.4}`, or stand for
            themselves, `**{"operator.c": 0.4}`. An installed component may also be given as its
            class, or as an instance, of which the run takes the options. None leaves an option out.

    Returns:
        The run, finished or stopped (`stop_after`).

    Raises:
        UserError: The input is bad; nothing was written.
        RunFailedError: Training failed; what there is was kept.
        KeyboardInterrupt: The user interrupted it. In the main thread of Python that happens after
            the step, and the run can be resumed.
    """
    settings = merged(None if config is None else Path(config), {"scene": scene, **options}, ())
    with _speaking(quiet=quiet), as_in_a_command():
        outcome = app.new(settings, _way(quiet=quiet, verbose=verbose))
    return _result(outcome)


def resume(
    folder: Path | str,
    *,
    accept_scene: bool = False,
    accept_plugins: bool = False,
    quiet: bool = False,
    verbose: bool = False,
    **options: object,
) -> Run:
    """Continues a stopped run, bit for bit.

    Args:
        folder: The run's folder.
        accept_scene: Go on although photos, masks or points of the scene have changed.
        accept_plugins: Go on with other versions of the packages that train the run.
        quiet: Shows no progress.
        verbose: Shows every decision and event.
        options: `device`, `threads` and `stop_after`; everything else stays as it was.

    Raises:
        UserError: It is no run, it is finished or in use, an option would change the training, or
            the scene or a package is another one.
        RunFailedError: Training failed; what there is was kept.
        KeyboardInterrupt: See `run`.
    """
    settings = merged(None, options, ())
    with _speaking(quiet=quiet), as_in_a_command():
        way = _way(quiet=quiet, verbose=verbose)
        accepted = {"accept_scene": accept_scene, "accept_plugins": accept_plugins}
        outcome = app.resumed(Path(folder), settings, way, **accepted)
    return _result(outcome)


@contextmanager
def _speaking(*, quiet: bool) -> Iterator[None]:
    """Tells the stages of the start, as a command does."""
    announce(quiet=quiet)
    try:
        yield
    finally:
        finish()


def _way(*, quiet: bool, verbose: bool) -> app.Way:
    return app.Way(-1 if quiet else int(verbose), _say_nothing)


def _say_nothing(table: str, folder: Path, words: Sequence[str]) -> None:
    """The returned object says it."""


def _result(outcome: app.Outcome) -> Run:
    """The run, or the exception that its ending calls for."""
    folder, ending = outcome.folder.resolve(), outcome.ending
    if ending.status == "failed":
        raise RunFailedError(folder, ending.error or "") from ending.cause
    if outcome.signal is None:
        return Run(folder)
    if outcome.signal != signal.SIGINT:
        raise SystemExit(outcome.exit_code)
    raise KeyboardInterrupt(f"the run is {ending.status}: {folder}")

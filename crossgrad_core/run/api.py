"""Runs from Python: like `crossgrad run`, but with exceptions instead of exit codes."""

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
    """Train a scene, evaluate it and export it, as `crossgrad run` does.

    Args:
        scene: Scene folder; the bundled example scene by default.
        config: YAML file with settings, such as the config.yaml of a run; `options` override the
            file.
        quiet: Show no progress.
        verbose: Show every decision and event.
        options: Named like the options of `crossgrad run` or like the keys of config.yaml:
            `backbone="scaffold"`, `seconds=60`, `max_size=800`, `out="runs/mine"`. The options of a
            component are given together with its name, `operator={"name": "cagrad", "c": 0.4}`, or
            one by one, `**{"operator.c": 0.4}`. An installed component may also be given as its
            class, or as an instance; the run then uses the options of the instance. An option with
            the value None is ignored.

    Returns:
        The run, finished or stopped (`stop_after`).

    Raises:
        UserError: The input is invalid; nothing was written.
        RunFailedError: Training failed; results that were already written are kept.
        KeyboardInterrupt: The user interrupted the run. In Python's main thread, this exception is
            raised after the current step, and the run can be resumed.
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
    """Continue a stopped run; an uninterrupted run would have bitwise equal results.

    Args:
        folder: The run's folder.
        accept_scene: Continue although photos, masks or points of the scene have changed.
        accept_plugins: Continue with other versions of the packages that train the run.
        quiet: Show no progress.
        verbose: Show every decision and event.
        options: `device`, `threads` and `stop_after`; no other setting can change.

    Raises:
        UserError: The folder is not a run, the run is finished or in use, an option would change
            the training, or the scene or a package has changed.
        RunFailedError: Training failed; results that were already written are kept.
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
    """Report the stages of the start as the command `crossgrad run` does."""
    announce(quiet=quiet)
    try:
        yield
    finally:
        finish()


def _way(*, quiet: bool, verbose: bool) -> app.Way:
    return app.Way(-1 if quiet else int(verbose), _say_nothing)


def _say_nothing(table: str, folder: Path, words: Sequence[str]) -> None:
    """Print nothing, because the returned object contains the results."""


def _result(outcome: app.Outcome) -> Run:
    """Return the run, or raise an exception if training failed or a signal stopped the run."""
    folder, ending = outcome.folder.resolve(), outcome.ending
    if ending.status == "failed":
        raise RunFailedError(folder, ending.error or "") from ending.cause
    if outcome.signal is None:
        return Run(folder)
    if outcome.signal != signal.SIGINT:
        raise SystemExit(outcome.exit_code)
    raise KeyboardInterrupt(f"the run is {ending.status}: {folder}")

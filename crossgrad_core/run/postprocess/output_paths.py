"""Output paths for later results of a run; files that summary.json describes are kept."""

import logging
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from crossgrad_core.errors import UserError
from crossgrad_core.run.load_run import require_checkpoint
from crossgrad_core.run.results.folder import clear_half_written
from crossgrad_core.run.results.lock import RunInUseError, locked
from crossgrad_core.run.results.scene_file import ACCEPTED
from crossgrad_core.run.results.summary import summarised_step
from crossgrad_core.training.setup import Setup

_LOG = logging.getLogger(__name__)


@contextmanager
def writing_if_possible(folder: Path, doing: str) -> Iterator[bool]:
    """Lock the run's folder and yield True; if the folder is read-only, warn and yield False."""
    with ExitStack() as stack:
        try:
            stack.enter_context(locked(folder, doing))
        except UserError as error:
            reason = f" ({error.found})" if error.found else ""
            _LOG.warning(
                "%s%s: results are only shown, and none is written there", error.what, reason
            )
            yield False
        else:
            clear_half_written(folder)
            yield True


@contextmanager
def writing(folder: Path, out: Path | None, doing: str) -> Iterator[None]:
    """Lock the run's folder, unless the results go to `out`."""
    # Check before taking the lock, because a folder of another kind must not be changed.
    require_checkpoint(folder)
    if out is not None:
        yield
        return
    try:
        with locked(folder, doing):
            clear_half_written(folder)
            yield
    except RunInUseError as error:
        raise UserError(
            error.what,
            where=error.where,
            found=error.found,
            todo="choose another output path with --out",
        ) from error


def is_changed(setup: Setup) -> bool:
    """Return True if the scene has changed; then the files that summary.json describes are kept."""
    return any(note.startswith(ACCEPTED) for note in setup.scene.notes)


def own_name(folder: Path, name: str, step: int) -> str:
    """Return a file name for results of a step that does not replace a file of another step.

    The run may have continued, and been killed, after summary.json and its files were written.
    """
    described = summarised_step(folder)
    if described in {None, step}:
        return name
    path = Path(name)
    return f"{path.stem}_step-{step:06d}{path.suffix}"

"""Output paths of results that are computed after a run.

Files that summary.json describes are not overwritten.
"""

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
    """Lock the run's folder and yield True; if this fails, log a warning and yield False."""
    with ExitStack() as stack:
        try:
            stack.enter_context(locked(folder, doing))
        except UserError as error:
            reason = f" ({error.found})" if error.found else ""
            _LOG.warning(
                "%s%s: results are shown in the terminal only and not written to the folder",
                error.what,
                reason,
            )
            yield False
        else:
            clear_half_written(folder)
            yield True


@contextmanager
def writing(folder: Path, out: Path | None, doing: str) -> Iterator[None]:
    """Lock the run's folder, unless the results go to `out`."""
    # Check the folder before taking the lock, because the lock would change a folder that is not a
    # run.
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
    """Return True if the scene has changed since the training.

    Files that summary.json describes must then not be overwritten.
    """
    return any(note.startswith(ACCEPTED) for note in setup.scene.notes)


def own_name(folder: Path, name: str, step: int) -> str:
    """Return a name for a file of results that does not replace a file of another step.

    A run may have been continued and killed after it wrote summary.json. Then summary.json and its
    files belong to an older step than the newest checkpoint.
    """
    described = summarised_step(folder)
    if described in {None, step}:
        return name
    path = Path(name)
    return f"{path.stem}_step-{step:06d}{path.suffix}"

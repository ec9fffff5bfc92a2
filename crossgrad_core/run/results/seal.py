"""The file SHA256SUMS of a run's folder, which is written when the run ends."""

from collections.abc import Iterator
from pathlib import Path
from typing import Final

from crossgrad_core.run.checkpoint import CHECKPOINTS
from crossgrad_core.run.results.lock import FILE as LOCK
from crossgrad_core.run.results.log import FILE as LOG
from crossgrad_core.run.results.sources import FILE as SOURCES
from crossgrad_core.system.checksums import SUMS, write_checksums
from crossgrad_core.system.files import is_leftover

#: Files without a line in SHA256SUMS. The checkpoints contain their own digests, and the other
#: files change after the end of the run.
_UNSEALED: Final = frozenset({SUMS, LOCK, LOG, CHECKPOINTS, SOURCES})


def seal(folder: Path) -> None:
    """Write SHA256SUMS with all files of a run that has ended.

    Raises:
        UserError: The disk is full.
    """
    write_checksums(folder, _final_files(folder))


def _final_files(folder: Path) -> Iterator[Path]:
    for path in folder.rglob("*"):
        top_name = path.relative_to(folder).parts[0]
        if path.is_file() and top_name not in _UNSEALED and not is_leftover(path):
            yield path

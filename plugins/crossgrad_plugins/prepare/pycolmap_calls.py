"""Long calls of pycolmap, and a check of models that pycolmap writes.

Models are checked before pycolmap reads them, because pycolmap never returns from truncated files.
"""

import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Final, TypeVar

from crossgrad_core.commands import Progress, UserError, disk_full
from crossgrad_core.scene.pycolmap_guard import guard_pycolmap
from crossgrad_plugins.readers.colmap_files.binary import read_binary

if TYPE_CHECKING:
    import pycolmap


T = TypeVar("T")
#: Seconds between two checks of a running call, and between two progress messages.
_LOOK, _PAUSE = 0.1, 10.0
#: Program that counts the rows of a database table. It is stopped after `_PATIENCE` seconds.
_COUNT: Final = (
    "import sqlite3, sys; found = sqlite3.connect(sys.argv[1] + '?mode=ro', uri=True);"
    "print(*found.execute('SELECT COUNT(*) FROM ' + sys.argv[2]).fetchone())"
)
_PATIENCE: Final = 5.0
#: Maximum number of bytes of the journal that SQLite writes beside a database.
JOURNAL: Final = 2**23
#: glog's level for fatal messages. Messages of lower levels do not help the user, because a failed
#: call raises an exception or does not write its file.
_FATAL: Final = 3
#: Files of a model that pycolmap's reader does not check -> number of bytes of a record. All
#: records of such a file have one size, because each rig is one camera and each frame is one photo.
_RECORDS: Final = {"rigs.bin": 16, "frames.bin": 84}
_COUNT_OF_RECORDS: Final = struct.Struct("<Q")


@contextmanager
def quiet() -> Iterator[None]:
    """Suppress pycolmap's messages inside the `with` block."""
    guard_pycolmap()
    import pycolmap

    before, pycolmap.logging.minloglevel = pycolmap.logging.minloglevel, _FATAL
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


def waited(
    what: str, call: "Callable[[pycolmap.CancellationToken], T]", far: Callable[[], str]
) -> T:
    """Run a long call in another thread, and return its result.

    The main thread stays free to handle signals.

    Args:
        what: Name of the call, for messages.
        call: The call, whose argument is a token for its cancellation.
        far: Function that returns the progress as text; it is called every few seconds.

    Raises:
        UserError: pycolmap failed; the message gives the reason.
    """
    guard_pycolmap()
    import pycolmap

    progress, begun, token = Progress(_PAUSE), monotonic(), pycolmap.CancellationToken()
    with quiet(), ThreadPoolExecutor(1, thread_name_prefix="crossgrad-prepare") as pool:
        future = pool.submit(call, token)
        try:
            while True:
                try:
                    return future.result(timeout=_LOOK)
                except TimeoutError:
                    if progress.due:
                        text = ", ".join(filter(None, [far(), f"{monotonic() - begun:.0f} s"]))
                        progress.tell(f"{what}: {text}")
        except (RuntimeError, ValueError, IndexError) as error:
            raise UserError(
                f"pycolmap failed in the stage {what}",
                found=str(error),
                todo="run the same command again; it continues after the last complete stage",
            ) from error
        except BaseException:
            token.cancel()
            raise


def rows_of(database: Path, table: str) -> int:
    """Return the number of rows of a table in COLMAP's database; 0 if unknown.

    The rows are counted in another process. In one process, Python's SQLite and pycolmap's SQLite
    would remove each other's locks and damage the database (https://sqlite.org/howtocorrupt.html,
    section 2.2.1).
    """
    program = [sys.executable, "-I", "-S", "-c", _COUNT, database.absolute().as_uri(), table]
    try:
        done = subprocess.run(program, capture_output=True, timeout=_PATIENCE, check=True)
        return int(done.stdout)
    except (OSError, ValueError, subprocess.SubprocessError):
        # The database is busy or does not exist yet.
        return 0


def write_model(model: "pycolmap.Reconstruction", folder: Path) -> None:
    """Write a model into an existing folder.

    Raises:
        UserError: The disk is full.
    """
    try:
        with quiet():
            model.write(folder)
    except (RuntimeError, ValueError) as error:  # The file could not be created.
        raise disk_full(folder, None) from error
    check_written(folder)


def check_written(folder: Path) -> None:
    """Refuse a truncated model that pycolmap has just written.

    Raises:
        UserError: The disk is full.
    """
    if not is_whole(folder):
        raise disk_full(folder, None)


def is_whole(folder: Path) -> bool:
    """Return True if all files of a model exist and are not truncated."""
    try:
        read_binary(folder)
    except UserError:
        return False
    points = (folder / "points3D.bin").is_file()
    return points and all(_has_all(folder / name, size) for name, size in _RECORDS.items())


def _has_all(path: Path, record: int) -> bool:
    """Return True if a file contains as many records as its header states."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        head = file.read(_COUNT_OF_RECORDS.size)
    return len(head) == _COUNT_OF_RECORDS.size and (
        path.stat().st_size >= _COUNT_OF_RECORDS.size + record * _COUNT_OF_RECORDS.unpack(head)[0]
    )

"""Long calls of pycolmap, and a check of the models that they write.

They are walked before pycolmap reads them: given files that are cut short it loops without an end.
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
#: Seconds between two looks at how far a call is, and between two lines about it.
_LOOK, _PAUSE = 0.1, 10.0
#: Counts the rows of a table, for which it waits so many seconds.
_COUNT: Final = (
    "import sqlite3, sys; found = sqlite3.connect(sys.argv[1] + '?mode=ro', uri=True);"
    "print(*found.execute('SELECT COUNT(*) FROM ' + sys.argv[2]).fetchone())"
)
_PATIENCE: Final = 5.0
#: Bytes that SQLite may write beside a database before it takes them over.
JOURNAL: Final = 2**23
#: Glog's level of what ends the process. What pycolmap says below that does not concern the user: a
#: failure that counts is told by its exception, or by what is missing afterwards.
_FATAL: Final = 3
#: Files of a model beside those that the reader walks -> bytes of a record, which are all alike:
#: each rig of `prepare` is one camera, and each frame one photo.
_RECORDS: Final = {"rigs.bin": 16, "frames.bin": 84}
_COUNT_OF_RECORDS: Final = struct.Struct("<Q")


@contextmanager
def quiet() -> Iterator[None]:
    """Pycolmap prints nothing inside the block."""
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
    """What a long call answers; it runs in another thread, so that signals are heard meanwhile.

    Args:
        what: What is done, for people.
        call: The call, with a token by which it can be cancelled.
        far: How far it is, in words; asked every few seconds.

    Raises:
        UserError: Pycolmap cannot do it; says why.
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
                        told = ", ".join(filter(None, [far(), f"{monotonic() - begun:.0f} s"]))
                        progress.tell(f"{what}: {told}")
        except (RuntimeError, ValueError, IndexError) as error:
            raise UserError(
                f"pycolmap failed: {what}",
                found=str(error),
                todo="run the same command again; it goes on from the last complete stage",
            ) from error
        except BaseException:
            token.cancel()
            raise


def rows_of(database: Path, table: str) -> int:
    """How many rows a table of COLMAP's database has, as far as it can be told now.

    Another process looks: Python's SQLite and that of pycolmap in one process take each other's
    locks away, and the database breaks (https://sqlite.org/howtocorrupt.html, section 2.2.1).
    """
    program = [sys.executable, "-I", "-S", "-c", _COUNT, database.absolute().as_uri(), table]
    try:
        done = subprocess.run(program, capture_output=True, timeout=_PATIENCE, check=True)
        return int(done.stdout)
    except (OSError, ValueError, subprocess.SubprocessError):  # It is busy, or not made yet.
        return 0


def write_model(model: "pycolmap.Reconstruction", folder: Path) -> None:
    """Writes a model into a folder that is there.

    Raises:
        UserError: The disk is full.
    """
    try:
        with quiet():
            model.write(folder)
    except (RuntimeError, ValueError) as error:  # A file could not even be made.
        raise disk_full(folder, None) from error
    check_written(folder)


def check_written(folder: Path) -> None:
    """Refuses a model that pycolmap has just written, and not to its end.

    Raises:
        UserError: The disk is full.
    """
    if not is_whole(folder):
        raise disk_full(folder, None)


def is_whole(folder: Path) -> bool:
    """Whether no file of a model is missing or cut short."""
    try:
        read_binary(folder)
    except UserError:
        return False
    points = (folder / "points3D.bin").is_file()
    return points and all(_has_all(folder / name, size) for name, size in _RECORDS.items())


def _has_all(path: Path, record: int) -> bool:
    """Whether a file has as many records as it says."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        head = file.read(_COUNT_OF_RECORDS.size)
    return len(head) == _COUNT_OF_RECORDS.size and (
        path.stat().st_size >= _COUNT_OF_RECORDS.size + record * _COUNT_OF_RECORDS.unpack(head)[0]
    )

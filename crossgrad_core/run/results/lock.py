"""The lock of a run's folder, so that only one process writes to the folder."""

import errno
import json
import os
import platform
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import BinaryIO, Literal

from typing_extensions import override

from crossgrad_core.errors import UserError
from crossgrad_core.system.check_writable import check_own
from crossgrad_core.system.files import disk_errors

#: Name of the lock file. After a process ends, the file still exists, but no process holds the
#: lock.
FILE = "run.lock"

_TAKEN = frozenset({errno.EAGAIN, errno.EACCES, errno.EWOULDBLOCK, errno.EDEADLK})
# On Windows, other processes cannot read locked bytes. Therefore lock a byte far after the content.
_FAR = 2**30
_MOST = 4096  # maximum number of bytes of the lock holder's description


@dataclass(frozen=True)
class Holder:
    """The process that holds the lock.

    Attributes:
        pid: Number of the process.
        host: Name of the machine.
        since: Local time at which the process took the lock, to the second.
        doing: What the process does in the folder.
    """

    pid: int
    host: str
    since: str
    doing: str

    @classmethod
    def me(cls, doing: str) -> "Holder":
        """Return the description of this process at this time."""
        now = datetime.now().astimezone()
        return cls(os.getpid(), platform.node(), now.strftime("%Y-%m-%d %H:%M:%S"), doing)

    @override
    def __str__(self) -> str:
        where = "" if self.host == platform.node() else f" on {self.host}"
        return f"process {self.pid}{where}, {self.doing} since {self.since}"


class RunInUseError(UserError):
    """Another process writes into the folder of a run."""


@contextmanager
def locked(folder: Path, doing: str) -> Iterator[bool]:
    """Prevent other processes from writing into a run's folder inside the block.

    The lock belongs to an open file of the process. Therefore the lock also ends if the process is
    killed.

    Args:
        folder: The run's folder.
        doing: The work of this process in the folder, for messages of other processes.

    Yields: True if the folder is locked, False if the file system does not support locks, as on
    some networks.

    Raises:
        RunInUseError: Another process holds the lock; the message names the process and its start
            time.
        UserError: The folder is not writable, or the lock is not a regular file.
    """
    path = folder / FILE
    check_own(path)
    with disk_errors(path):
        # Do not use a buffer. When a file is closed, its buffer tries again to write data that did
        # not fit on the disk, and fails again.
        file = os.fdopen(os.open(path, os.O_RDWR | os.O_CREAT, 0o666), "r+b", buffering=0)
    with file:
        taken = _take(file)
        if taken == "by another":
            raise _in_use(folder, _read(file))
        with disk_errors(path):
            _write(file, json.dumps(asdict(Holder.me(doing))))
        try:
            yield taken == "by us"
        finally:
            with suppress(OSError):
                _write(file, "")


def writer_of(folder: Path) -> str | None:
    """Describe the process that currently writes into the folder; None without a known process."""
    try:
        with (folder / FILE).open("r+b") as file:
            return _named(_read(file)) if _take(file) == "by another" else None
    except OSError:
        return None


def _in_use(folder: Path, holder: Holder | None) -> RunInUseError:
    return RunInUseError(
        "another process is writing to this folder",
        where=folder,
        found=_named(holder),
        todo="wait until the process ends, or stop it",
    )


def _named(holder: Holder | None) -> str:
    return "a process that holds the lock of the folder" if holder is None else str(holder)


def _take(file: BinaryIO) -> Literal["by us", "by another", "not at all"]:
    """Try to take the lock and return who holds it; `not at all` on file systems without locks."""
    try:
        _lock(file)
    except OSError as error:
        return "by another" if error.errno in _TAKEN else "not at all"
    return "by us"


def _lock(file: BinaryIO) -> None:
    if sys.platform == "win32":
        import msvcrt

        file.seek(_FAR)
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
    else:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _write(file: BinaryIO, text: str) -> None:
    file.seek(0)
    file.truncate()
    file.write(text.encode())


def _read(file: BinaryIO) -> Holder | None:
    """Return the description of the holder; None if it is not written yet or not valid."""
    file.seek(0)
    try:
        return Holder(**json.loads(file.read(_MOST)))
    except (OSError, TypeError, ValueError, RecursionError):
        return None

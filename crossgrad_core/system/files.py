"""Functions that write a file completely or not at all, and user errors for disk errors."""

import errno
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from crossgrad_core.errors import UserError
from crossgrad_core.system.interrupts import UNFINISHED

_FULL = frozenset({errno.ENOSPC, errno.EDQUOT})
_TEMPORARY = re.compile(r"\..+\.(\d+)\.tmp", re.DOTALL)
_FORBIDDEN = frozenset({errno.EACCES, errno.EPERM, errno.EROFS})
_IN_THE_WAY = frozenset({errno.EISDIR, errno.ENOTDIR, errno.EEXIST, errno.ELOOP})


def size_text(count: int) -> str:
    """Format a number of bytes in KiB, MiB or GiB."""
    if count < 2**20:
        return f"{count / 2**10:,.1f} KiB"
    if count < 2**30:
        return f"{count / 2**20:,.1f} MiB"
    return f"{count / 2**30:,.1f} GiB"


def free_bytes(path: Path) -> int:
    """Return the free bytes of the file system of `path`, which need not exist yet."""
    existing = path.absolute()
    while not os.path.exists(existing):  # `os.path.exists` raises no error for a long name.
        existing = existing.parent
    return shutil.disk_usage(existing).free


def disk_full(path: Path, needed: int | None) -> UserError:
    """Return the error for a full disk; `needed` is the size in bytes of the file to write."""
    return UserError(
        "there is not enough disk space",
        where=path,
        expected=f"{size_text(needed)} free" if needed is not None else "",
        found=f"{size_text(free_bytes(path))} free",
        todo="free some space, or choose another disk",
    )


def read_only(path: Path) -> UserError:
    """Return the error for a path that is not writable."""
    return UserError(
        "crossgrad cannot write to this path",
        where=path,
        expected="a folder with write permission",
        todo="check the permissions of the path, or choose another path",
    )


def path_too_long(path: object) -> UserError:
    """Return the error for a path that is too long for the file system."""
    return UserError(
        "the path is too long for the file system",
        where=path,
        expected="names of at most 255 bytes, and on most systems at most 4,096 bytes in "
        "total, including the names of the result files",
        todo="choose a shorter path",
    )


def is_too_long(error: OSError) -> bool:
    """Return True if the error means that a path is too long for the file system."""
    return error.errno == errno.ENAMETOOLONG


def is_full(error: OSError) -> bool:
    """Return True if the error means that the disk or quota is full."""
    return error.errno in _FULL


@contextmanager
def disk_errors(path: Path, needed: int | None = None) -> Iterator[None]:
    """Convert errors about disk space, permissions, kinds of files and long paths to a `UserError`.

    Args:
        path: The file that is being written.
        needed: Size of the file in bytes, if known.
    """
    try:
        yield
    except OSError as error:
        if is_full(error):
            raise disk_full(path, needed) from error
        if error.errno in _FORBIDDEN:
            raise read_only(path) from error
        if error.errno in _IN_THE_WAY:
            what, found = "another file or folder already has this name", error.strerror or ""
            raise UserError(
                what, where=path, found=found, todo="move that file or folder to another path"
            ) from error
        if is_too_long(error):
            raise path_too_long(path) from error
        raise


@contextmanager
def atomic_file(path: Path, needed: int | None = None) -> Iterator[BinaryIO]:
    """Yield a binary file that replaces `path` when the block ends without an error.

    The content is on the disk before the file gets its name. Therefore a crash leaves either the
    complete old file or the complete new file.

    Raises:
        UserError: The disk is full or the folder is not writable; an old file stays unchanged.
    """
    temporary = unfinished_name(path)
    with disk_errors(path, needed):
        UNFINISHED.add(str(temporary))
        try:
            with temporary.open("wb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
            sync_folder(path.parent)
        finally:
            temporary.unlink(missing_ok=True)
            UNFINISHED.discard(str(temporary))


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Yield a new folder that gets the name `path` when the block ends without an error.

    Raises:
        UserError: The disk is full, the parent folder is not writable, or `path` exists.
    """
    temporary = unfinished_name(path)
    with disk_errors(path):
        if os.path.lexists(path):
            raise FileExistsError(errno.EEXIST, "the folder exists already")
        UNFINISHED.add(str(temporary))
        try:
            temporary.mkdir()
            yield temporary
            for written in temporary.rglob("*"):
                if written.is_file():
                    sync_file(written)
            temporary.rename(path)
            sync_folder(path.parent)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
            UNFINISHED.discard(str(temporary))


def unfinished_name(path: Path) -> Path:
    """Return the temporary name of a file that is not complete yet."""
    return path.with_name(f".{path.name}.{os.getpid()}.tmp")


def is_leftover(path: Path) -> bool:
    """Return True if the path has the temporary name of an unfinished file."""
    return _TEMPORARY.fullmatch(path.name) is not None


def clear_leftovers(folder: Path, *, shared: bool = False) -> None:
    """Delete the half-written files and folders that killed processes left in a folder.

    Args:
        folder: The folder.
        shared: True if other processes may write into the folder; then files of running processes
            are kept.
    """
    for path in folder.glob(".*.tmp"):
        named = _TEMPORARY.fullmatch(path.name)
        if named and not (shared and _is_alive(int(named[1]))):
            remove(path)


def remove(path: Path) -> None:
    """Delete a file, or a folder with its content, if it exists."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _is_alive(process: int) -> bool:
    """Return True if another process of this machine has this process number."""
    # A file with the number of this process was written by an earlier process. Process numbers
    # repeat in a container, for example.
    if process == os.getpid():
        return False
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True


def text_bytes(text: str) -> bytes:
    r"""Return a text in UTF-8; bytes of a file name that are not UTF-8 become `\udc80` or similar.

    In JSON and YAML, the text `\udc80` is an escape that restores the name when the file is read.
    """
    return text.encode(errors="backslashreplace")


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file completely or not at all."""
    with atomic_file(path, len(content)) as file:
        file.write(content)


def sync_file(path: Path) -> None:
    """Wait until the content of a written file is on the disk."""
    with path.open("rb+") as file:
        os.fsync(file.fileno())


def sync_folder(folder: Path) -> None:
    """Wait until new names in the folder are on the disk, if the system supports such a wait."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)

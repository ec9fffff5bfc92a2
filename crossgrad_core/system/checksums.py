"""SHA256SUMS: the digests of final files, in the format of the program `sha256sum`.

The digest reveals a file that was damaged or edited afterwards. A folder without SHA256SUMS, and a
file that SHA256SUMS does not list, are not checked.
"""

import logging
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from hashlib import file_digest
from pathlib import Path
from typing import Final

from crossgrad_core.errors import UserError
from crossgrad_core.system.files import disk_errors, write_atomically
from crossgrad_core.system.input_files import open_file, read_file
from crossgrad_core.wording import one_line

_LOG = logging.getLogger(__name__)
#: Name of the file with the digests in a folder of results.
SUMS: Final = "SHA256SUMS"
_LINE: Final = re.compile(r"([0-9a-f]{64})  (.+)")
#: Characters that would need escapes in SHA256SUMS. The file does not list names with these
#: characters.
_UNLISTED: Final = re.compile(r"[\n\r\\]")


def digest_of(path: Path) -> str:
    """Return the SHA-256 of a file in hexadecimal digits.

    Raises:
        OSError: The file cannot be read.
    """
    with open_file(path) as file:
        return file_digest(file, "sha256").hexdigest()


def write_checksums(folder: Path, paths: Iterable[Path]) -> None:
    """Write SHA256SUMS with the digests of files below the folder.

    Raises:
        UserError: The disk is full, or the folder is not writable.
    """
    with disk_errors(folder / SUMS):
        digests = {path.relative_to(folder).as_posix(): digest_of(path) for path in paths}
    _write(folder, digests)


def drop_checksums(folder: Path) -> None:
    """Remove SHA256SUMS, before files in the folder change."""
    with disk_errors(folder / SUMS):
        (folder / SUMS).unlink(missing_ok=True)


@contextmanager
def relisted(folder: Path, *names: str) -> Iterator[None]:
    """Let the block replace files of a folder, and then write the new digests to SHA256SUMS.

    If the process is killed inside the block, SHA256SUMS does not list these files. In a folder
    without SHA256SUMS, the file is not created.

    Args:
        folder: The folder.
        names: Files and folders that the block writes, as paths below the folder.
    """
    listed = (folder / SUMS).is_file()
    rest = {
        path: digest
        for path, digest in (read_checksums(folder) if listed else {}).items()
        if not any(path == name or path.startswith(f"{name}/") for name in names)
    }
    if listed:
        _write(folder, rest)
    yield
    if listed:
        _write(folder, {**rest, **_digests(folder, names)})


def _digests(folder: Path, names: Iterable[str]) -> dict[str, str]:
    """Return the digests of files, and of all files in folders."""
    places = [folder / name for name in names]
    files = [path for root in places for path in (root, *root.rglob("*")) if path.is_file()]
    return {path.relative_to(folder).as_posix(): digest_of(path) for path in files}


def read_checksums(folder: Path) -> dict[str, str]:
    """Return a dict from file name to digest; the dict is empty if SHA256SUMS does not exist.

    Raises:
        UserError: A line does not have the format of `sha256sum`.
    """
    path = folder / SUMS
    try:
        text = os.fsdecode(read_file(path))
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise _unreadable(path, error.strerror or str(error)) from error
    digest_by_name = {}
    for line in text.splitlines():
        match = _LINE.fullmatch(line)
        if match is None:
            raise _unreadable(path, one_line(line))
        digest_by_name[match[2]] = match[1]
    return digest_by_name


def changed_files(folder: Path, names: Iterable[str] | None = None) -> list[str]:
    """Return the listed files that are missing or have another digest.

    Args:
        folder: The folder.
        names: The files to check; by default all listed files.

    Raises:
        UserError: SHA256SUMS or a file cannot be read.
    """
    sums = read_checksums(folder)
    wanted = sums if names is None else [name for name in names if name in sums]
    return [name for name in wanted if not _is(folder / name, sums[name])]


def check_unchanged(folder: Path, names: Iterable[str], todo: str) -> None:
    """Refuse files whose digest differs from SHA256SUMS.

    Args:
        folder: The folder.
        names: The files that are going to be read. Files that SHA256SUMS does not list are not
            checked.
        todo: Advice on how to restore the files.

    Raises:
        UserError: The digest of a file differs; the message names the first such file.
    """
    for name in changed_files(folder, names):
        raise UserError(
            f"{name} has changed since crossgrad wrote it",
            where=folder / name,
            expected=f"a file with the SHA-256 in {SUMS}",
            found="another SHA-256" if (folder / name).is_file() else "no such file",
            todo=f"{todo}; or remove {SUMS} to accept the file as it is",
        )


def warn_if_changed(path: Path) -> None:
    """Log a warning if the digest of a file differs from SHA256SUMS."""
    if changed_files(path.parent, [path.name]):
        _LOG.warning("%s has changed since its run wrote it: its SHA-256 differs", path)


def _is(path: Path, digest: str) -> bool:
    try:
        return digest_of(path) == digest
    except OSError:
        return False


def _write(folder: Path, digests: Mapping[str, str]) -> None:
    listed = {name: digest for name, digest in digests.items() if not _UNLISTED.search(name)}
    text = "".join(f"{digest}  {name}\n" for name, digest in sorted(listed.items()))
    write_atomically(folder / SUMS, os.fsencode(text))


def _unreadable(path: Path, found: str) -> UserError:
    return UserError(
        f"{SUMS} cannot be read",
        where=path,
        expected="lines of a SHA-256 in hexadecimal digits, two spaces and a file name",
        found=found,
        todo="restore the file from a copy, or remove the file; then no file of the folder is "
        "checked",
    )

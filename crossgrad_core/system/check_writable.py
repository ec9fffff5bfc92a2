"""Checks, before any work, whether results can be written; the checks leave no files."""

import os
import tempfile
from pathlib import Path
from typing import Final

from crossgrad_core.errors import UserError
from crossgrad_core.system.files import (
    disk_errors,
    disk_full,
    free_bytes,
    path_too_long,
    read_only,
    unfinished_name,
)

#: Maximum number of bytes that the path of a file inside a folder of results adds to the folder's
#: path.
_BELOW: Final = 200


def check_folder(folder: Path, needed: int = 0) -> None:
    """Refuse a folder that cannot be created or written to, or whose disk is too full.

    Args:
        folder: The folder; it need not exist yet.
        needed: Number of bytes that will be written.

    Raises:
        UserError: The folder cannot be used; the message states the reason and a remedy.
    """
    existing = folder.absolute()
    while not os.path.lexists(existing):
        existing = existing.parent
    _check_length(folder, existing)
    if not existing.is_dir():
        raise UserError(
            "the folder cannot be created",
            where=folder,
            found=f"{existing} is not a folder",
            todo="choose another path, or remove the file",
        )
    try:
        # Write a test file, because permission bits are not reliable on network file systems.
        with disk_errors(folder), tempfile.TemporaryFile(dir=existing) as probe:
            probe.write(b"crossgrad")
    # Some file systems, such as /proc, raise errors that `disk_errors` does not convert.
    except OSError as error:
        raise read_only(folder) from error
    if needed and free_bytes(existing) < needed:
        raise disk_full(folder, needed)


def _check_length(folder: Path, existing: Path) -> None:
    """Refuse a folder whose path is too long for the paths of the files in it."""
    name, path = (
        os.pathconf(existing, limit) if hasattr(os, "pathconf") else default
        for limit, default in (("PC_NAME_MAX", 255), ("PC_PATH_MAX", 4096))
    )
    longest = max(len(os.fsencode(part)) for part in folder.absolute().parts)
    if longest > name or len(os.fsencode(folder.absolute())) + _BELOW > path:
        raise path_too_long(folder)


def check_own(path: Path) -> None:
    """Refuse a link, pipe or device in place of a file that is written in place.

    The target of a link would be overwritten, and a pipe would block forever.

    Raises:
        UserError: A link, a pipe, a device or a folder has the name of the file.
    """
    if path.is_symlink() or (path.exists() and not path.is_file()):
        found = f"a link to {path.resolve()}" if path.is_symlink() else "a pipe, device or folder"
        raise UserError(
            "the output path is a link or a special file, which crossgrad does not write to",
            where=path,
            found=found,
            todo="remove the link or the special file",
        )


def check_new(*paths: Path) -> None:
    """Refuse files that already exist, so that no file of the user is overwritten.

    Raises:
        UserError: A file exists; the message names the first existing file.
    """
    for path in paths:
        with disk_errors(path):
            if path.exists():
                todo = "choose another path, or remove the file"
                raise UserError("the output file already exists", where=path, todo=todo)


def check_name(path: Path) -> None:
    """Refuse a file if its temporary name, which is longer than its name, is too long.

    Raises:
        UserError: The name or the path is too long.
    """
    with disk_errors(path):
        unfinished_name(path).exists()


def check_file(path: Path) -> None:
    """Refuse a file that is a folder, or whose folder is missing or not writable.

    Raises:
        UserError: The file cannot be written; the message states the reason and a remedy.
    """
    check_name(path)
    if path.is_dir():
        raise UserError(
            "the output path is a folder, but a file is to be written",
            where=path,
            todo="name a file in the folder",
        )
    if not path.parent.is_dir():
        raise UserError(
            "the folder of the output file does not exist",
            where=path,
            todo=f"create {path.parent}, or choose another path",
        )
    check_folder(path.parent)

"""Whether results can be written, asked before the work that leads to them; nothing stays."""

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

#: Bytes of the longest path of a file below a folder of results.
_BELOW: Final = 200


def check_folder(folder: Path, needed: int = 0) -> None:
    """Refuses a folder that cannot be made or written to, or whose disk is too full.

    Args:
        folder: The folder, which need not exist yet.
        needed: Bytes that will be written.

    Raises:
        UserError: What is in the way, and what to do.
    """
    place = folder.absolute()
    while not os.path.lexists(place):
        place = place.parent
    _check_length(folder, place)
    if not place.is_dir():
        raise UserError(
            "cannot make this folder",
            where=folder,
            found=f"{place} is no folder",
            todo="choose another place, or remove that file",
        )
    try:
        # Permission bits do not tell the truth on network file systems; writing does.
        with disk_errors(folder), tempfile.TemporaryFile(dir=place) as probe:
            probe.write(b"crossgrad")
    except OSError as error:  # Of a kind of its own, as in /proc.
        raise read_only(folder) from error
    if needed and free_bytes(place) < needed:
        raise disk_full(folder, needed)


def _check_length(folder: Path, place: Path) -> None:
    """Refuse a folder whose path leaves no room for those of the files in it."""
    name, path = (
        os.pathconf(place, limit) if hasattr(os, "pathconf") else default
        for limit, default in (("PC_NAME_MAX", 255), ("PC_PATH_MAX", 4096))
    )
    longest = max(len(os.fsencode(part)) for part in folder.absolute().parts)
    if longest > name or len(os.fsencode(folder.absolute())) + _BELOW > path:
        raise path_too_long(folder)


def check_own(path: Path) -> None:
    """Refuses what stands in place of a file that is written where it is.

    What a link leads to would be overwritten, and a pipe waited for without an end.

    Raises:
        UserError: There is a link, a pipe or a device.
    """
    if path.is_symlink() or (path.exists() and not path.is_file()):
        found = f"a link to {path.resolve()}" if path.is_symlink() else "a pipe, device or folder"
        raise UserError(
            "this is written to, and is no file of its own",
            where=path,
            found=found,
            todo="remove it",
        )


def check_new(*paths: Path) -> None:
    """Refuses files that are there already: nothing of the user's is overwritten.

    Raises:
        UserError: The first of them.
    """
    for path in paths:
        with disk_errors(path):
            if path.exists():
                todo = "choose another place, or remove it"
                raise UserError("the file exists", where=path, todo=todo)


def check_name(path: Path) -> None:
    """Refuse a file whose name leaves no room for that of its unfinished form.

    Raises:
        UserError: The name or the path is too long.
    """
    with disk_errors(path):
        unfinished_name(path).exists()


def check_file(path: Path) -> None:
    """Refuses a file that cannot be written because of its folder or because it is one.

    Raises:
        UserError: What is in the way, and what to do.
    """
    check_name(path)
    if path.is_dir():
        raise UserError(
            "a file is to be written, and this is a folder", where=path, todo="name a file in it"
        )
    if not path.parent.is_dir():
        raise UserError(
            "the folder of this file is not there",
            where=path,
            todo=f"make {path.parent}, or choose another place",
        )
    check_folder(path.parent)

"""The output folder of a comparison, in which only files of a comparison are replaced."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final

from crossgrad_core.commands import (
    UserError,
    check_folder,
    clear_half_written,
    disk_errors,
    is_leftover,
    write_atomically,
)

#: Name of the page. A page with the tag `MARK` shows that a folder was written by a comparison.
PAGE: Final = "index.html"
#: `compare` writes this tag in the head of each page.
MARK: Final = '<meta name="generator" content="crossgrad compare">'
FIGURES: Final = "figures"
_BEGINNING: Final = 2000


def check_free(folder: Path, owned: Iterable[str] = ()) -> None:
    """Refuse a folder that contains files other than those of an earlier comparison.

    The folder of an interrupted comparison has no page yet, but contains only files of a
    comparison.

    Args:
        folder: The folder.
        owned: Paths below the folder of all files that a comparison may write besides its page.

    Raises:
        UserError: The folder contains other files; the message names these files and what to do.
    """
    check_folder(folder)
    if not folder.is_dir() or is_comparison(folder):
        return
    allowed = {PAGE, *owned} if (folder / FIGURES).is_dir() else set()
    there = (*folder.glob("*"), *(folder / FIGURES).glob("*"))
    others = (
        path
        for path in there
        if path.relative_to(folder).as_posix() not in {*allowed, FIGURES} and not is_leftover(path)
    )
    if next(others, None) is None and not (folder / PAGE).exists():
        return
    raise UserError(
        "the folder contains files that do not belong to a comparison",
        where=folder,
        expected="a new or empty folder, or a folder that compare wrote",
        found=", ".join(sorted(path.name for path in folder.iterdir())[:5]),
        todo="choose another --out, or remove the folder",
    )


def is_comparison(folder: Path) -> bool:
    """Return True if `crossgrad compare` wrote this folder."""
    page = folder / PAGE
    if not page.is_file():
        return False
    with page.open(encoding="utf-8", errors="replace") as file:
        return MARK in file.read(_BEGINNING)


def write_files(folder: Path, files: Mapping[str, bytes], owned: Iterable[str]) -> None:
    """Write the files, with the page last, and remove old files of an earlier comparison.

    Args:
        folder: The folder; it is free or contains an earlier comparison.
        files: Path below the folder -> content.
        owned: Paths below the folder of all files that a comparison may write besides its page.

    Raises:
        UserError: The disk is full, or the folder is read-only.
    """
    with disk_errors(folder):
        (folder / FIGURES).mkdir(parents=True, exist_ok=True)
        for name in owned:
            if name not in files:
                (folder / name).unlink(missing_ok=True)
    for directory in (folder, folder / FIGURES):
        clear_half_written(directory, shared=True)
    for name in sorted(files, key=lambda name: name == PAGE):
        write_atomically(folder / name, files[name])

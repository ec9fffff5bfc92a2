"""Models as pycolmap writes them: it does not say when the disk is full, so each is looked at.

They are walked before pycolmap reads them: given files that are cut short it loops without an end.
"""

import struct
from pathlib import Path
from typing import TYPE_CHECKING, Final

from crossgrad_core.commands import UserError, disk_full
from crossgrad_plugins.prepare.subprocess_wait import quiet
from crossgrad_plugins.readers._colmap_binary import read_binary

if TYPE_CHECKING:
    import pycolmap

#: Files of a model beside those that the reader walks -> bytes of a record, which are all alike:
#: each rig of `prepare` is one camera, and each frame one photo.
_RECORDS: Final = {"rigs.bin": 16, "frames.bin": 84}
_COUNT: Final = struct.Struct("<Q")


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
        head = file.read(_COUNT.size)
    return len(head) == _COUNT.size and (
        path.stat().st_size >= _COUNT.size + record * _COUNT.unpack(head)[0]
    )

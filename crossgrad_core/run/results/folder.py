"""The output folder of a run.

Before training, the folder must be new and writable, and the disk must have enough space.
"""

import re
import tempfile
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from crossgrad_core.errors import UserError
from crossgrad_core.run.results.config_file import FILE as CONFIG
from crossgrad_core.run.results.lock import FILE as LOCK
from crossgrad_core.run.results.lock import writer_of
from crossgrad_core.run.results.panels import FOLDER as RENDERS
from crossgrad_core.system.files import (
    clear_leftovers,
    disk_errors,
    disk_full,
    free_bytes,
    is_leftover,
)

#: Number of bytes that a run of a small scene with few renders writes at most.
SMALLEST_NEED = 64 * 2**20
#: Folder that contains all runs, relative to the working folder.
RUNS = Path("runs")
_UNSAFE = re.compile(r"[^\w.+-]+")


@dataclass(frozen=True)
class RunName:
    """The parts of a run's name.

    Attributes:
        scene: Name of the scene.
        backbone: Name of the backbone.
        sampler: Name of the sampler.
        operator: Name of the operator.
        started: Local time of the start.
    """

    scene: str
    backbone: str
    sampler: str
    operator: str
    started: datetime

    @property
    def folder(self) -> Path:
        """<scene>/<backbone>-<sampler>-<operator>/<YYYYmmdd-HHMMSS>."""
        method = f"{self.backbone}-{self.sampler}-{self.operator}"
        parts = (self.scene, method, self.started.strftime("%Y%m%d-%H%M%S"))
        return Path(*(_safe(part) for part in parts))


def create_run_folder(
    name: RunName, out: Path | None = None, root: Path = RUNS, needed: int = SMALLEST_NEED
) -> Path:
    """Create the output folder of a new run.

    Args:
        name: The parts of the name of the folder below `root`; if two runs start in the same
            second, the later run gets the suffix -2.
        out: The output folder if the user named a folder; it must be new or empty.
        root: Folder of all runs.
        needed: Number of bytes that the run writes at most.

    Raises:
        UserError: `out` is not empty, the folder is not writable, or the disk is too full.
    """
    check_out(out)
    wanted = out if out is not None else root / name.folder
    if free_bytes(wanted) < needed:
        raise disk_full(wanted, needed)
    with disk_errors(wanted):
        folder = _made(wanted, taken=out is not None)
        # Write a test file, because permission bits are not reliable on network file systems.
        with tempfile.TemporaryFile(dir=folder) as probe:
            probe.write(b"crossgrad")
    return folder


def check_out(out: Path | None) -> None:
    """Refuse a folder that is not empty, before anything is created.

    A lock file and half-written files of a killed run are allowed.

    Raises:
        UserError: `out` is a file or is not empty.
    """
    if out is None:
        return
    with disk_errors(out):
        if not out.exists():
            return
    if not out.is_dir():
        raise UserError(
            "the output path is a file, not a folder",
            where=out,
            todo="choose another --out, or remove the file",
        )
    there = sorted(p.name for p in out.iterdir() if p.name != LOCK and not is_leftover(p))
    if there:
        writer = writer_of(out)
        raise UserError(
            "the output folder is not empty; crossgrad never overwrites results",
            where=out,
            expected="a new or empty folder",
            found=", ".join(there[:4]) + (f" of {writer}" if writer else ""),
            todo="choose another --out"
            + (", or resume that run with --resume" if CONFIG in there else ""),
        )


def clear_half_written(folder: Path) -> None:
    """Delete half-written files of killed processes in the locked folder of a run."""
    renders = (path for path in (folder / RENDERS).rglob("*") if path.is_dir())
    for directory in (folder, folder / RENDERS, *renders):
        clear_leftovers(directory)


def expected_bytes(primitives: int, checkpoints: int) -> int:
    """Estimate the number of bytes that a run writes in checkpoints and in one PLY file."""
    # Add one checkpoint, because all old checkpoints exist while a new checkpoint is written.
    floats = 59 * 3 * (checkpoints + 1) + 62
    return max(SMALLEST_NEED, 4 * floats * primitives)


def _safe(part: str) -> str:
    """Return a path component that every file system accepts."""
    return _UNSAFE.sub("_", part).strip(".") or "_"


def _made(wanted: Path, *, taken: bool) -> Path:
    if taken:
        wanted.mkdir(parents=True, exist_ok=True)
        return wanted
    folder, number = wanted, 1
    while True:
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            number += 1
            folder = wanted.with_name(f"{wanted.name}-{number}")
        else:
            return folder

"""The folders of checkpoints: which are complete, how one gets its name, which are deleted."""

import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from crossgrad_core.errors import UserError
from crossgrad_core.system.files import sync_folder

CHECKPOINTS = "checkpoints"
TENSORS = "tensors.safetensors"
STATE = "state.json"

_STEP = re.compile(r"step-(\d{6,})")
_SCRATCH = ".scratch-"


@dataclass(frozen=True)
class Keep:
    """Which checkpoints survive the writing of a new one.

    Attributes:
        last: The newest so many, the new one included.
        every: And those at multiples of this step; None for no others.
    """

    last: int = 2
    every: int | None = None

    def drops(self, steps: list[int]) -> list[int]:
        """Those of `steps` that are to be deleted."""
        old = sorted(steps)[: -self.last]
        return [step for step in old if self.every is None or step % self.every]


def is_checkpoint(folder: Path) -> bool:
    """Whether this is the folder of a checkpoint, of which files may have been lost since."""
    return _STEP.fullmatch(folder.name) is not None and folder.is_dir()


def is_complete(folder: Path) -> bool:
    """Whether all files of a checkpoint are there."""
    return (folder / STATE).is_file() and (folder / TENSORS).is_file()


def named_checkpoints(folder: Path) -> dict[int, Path]:
    """Return step -> folder of the checkpoints in `folder`, in the order of steps.

    A checkpoint gets its name when all of its files are there. One that lacks a file is damaged. It
    is not passed over, because an older one would then be taken in its place without a word.
    """
    if not folder.is_dir():
        return {}
    found = [path for path in folder.iterdir() if is_checkpoint(path)]
    by_step = {int(path.name.removeprefix("step-")): path for path in found}
    return dict(sorted(by_step.items()))


def damaged(folder: Path, found: str) -> UserError:
    """The error for a checkpoint that cannot be used; points to another one if there is one."""
    named = named_checkpoints(folder.parent).values()
    others = [path for path in named if path.name != folder.name and is_complete(path)]
    return UserError(
        "damaged checkpoint",
        where=folder,
        found=found,
        todo=f"remove it; the run then goes on from {others[-1].name}"
        if others
        else "start the run again",
    )


@contextmanager
def scratch_folder(final: Path) -> Iterator[Path]:
    """A folder to write into that gets the name `final` when the block ends without an error."""
    scratch = final.with_name(f"{_SCRATCH}{final.name}")
    final.parent.mkdir(parents=True, exist_ok=True)
    _clear(final.parent)
    try:
        scratch.mkdir()
        yield scratch
        sync_folder(scratch)
        _take_name(scratch, final)
    finally:
        _clear(final.parent)


def discard(folder: Path) -> None:
    """Deletes a checkpoint in such a way that half of one never looks complete."""
    doomed = folder.with_name(f"{_SCRATCH}old-{folder.name}")
    folder.rename(doomed)
    shutil.rmtree(doomed)


def _take_name(scratch: Path, final: Path) -> None:
    if not final.exists():
        scratch.rename(final)
    else:
        old = final.with_name(f"{_SCRATCH}old-{final.name}")
        final.rename(old)
        try:
            scratch.rename(final)
        except OSError:
            old.rename(final)
            raise
    sync_folder(final.parent)


def _clear(folder: Path) -> None:
    """Deletes what this or an interrupted run left half-written."""
    for path in folder.glob(f"{_SCRATCH}*"):
        shutil.rmtree(path, ignore_errors=True)

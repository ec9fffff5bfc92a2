"""Copies of a run's files in its checkpoints, which help to detect or repair damage."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, cast

from crossgrad_core.config import CHANGEABLE
from crossgrad_core.contract.blocks import Json
from crossgrad_core.run.results.config_file import FILE as CONFIG
from crossgrad_core.run.results.config_file import NOTES
from crossgrad_core.run.results.metrics_csv import FILE as METRICS
from crossgrad_core.system.files import write_atomically
from crossgrad_core.system.input_files import read_file
from crossgrad_core.system.yaml_values import read_mapping, read_yaml
from crossgrad_core.wording import listed

#: Key of the scalar in a checkpoint that contains the text files as a mapping: file name ->
#: content.
KEY: Final = "files"
#: Settings that a run with a time budget rewrites.
_REVISED: Final = frozenset({"steps", "revisions"})


def kept_files(folder: Path) -> dict[str, Json]:
    """Return file name -> content for the existing files that a checkpoint stores."""
    contents = {name: _content(folder / name) for name in (CONFIG, METRICS)}
    return {
        name: text.decode(errors="replace") for name, text in contents.items() if text is not None
    }


def restored(folder: Path, scalars: Mapping[str, Any], step: int) -> tuple[str, ...]:
    """Restore metrics.csv as it was at a checkpoint; later rows are removed.

    Args:
        folder: The run's folder.
        scalars: The scalars of the checkpoint.
        step: The step of the checkpoint.

    Returns:
        A note if the file was damaged.
    """
    text = (scalars.get(KEY) or {}).get(METRICS)
    present = _content(folder / METRICS)
    if text is None or present == text.encode():
        return ()  # The checkpoint contains no copy of the file, or the file is equal to the copy.
    write_atomically(folder / METRICS, text.encode())
    if present is not None and present.startswith(text.encode()):
        return ()
    was = "was gone" if present is None else "was damaged"
    return (f"{METRICS} {was}: it is restored to its state at step {step}",)


def edited(folder: Path, scalars: Mapping[str, Any]) -> tuple[str, ...]:
    """Return a note if config.yaml has changed since the checkpoint was written."""
    text = (scalars.get(KEY) or {}).get(CONFIG)
    if text is None:
        return ()
    was = cast("dict[str, Any]", read_yaml(text))
    now = read_mapping(folder / CONFIG, "the configuration of the run", "restore the file")
    names = (was.keys() | now.keys()) - _REVISED - CHANGEABLE
    changed = sorted(name for name in names if was.get(name) != now.get(name))
    if not changed:
        return ()
    parts = (name if name == NOTES else _difference(name, was, now) for name in changed)
    return (f"{CONFIG} was edited after its run wrote it: {listed(parts)}",)


def _difference(name: str, was: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    return f"{name} {was.get(name)} is now {now.get(name)}"


def _content(path: Path) -> bytes | None:
    try:
        return read_file(path)
    except OSError:
        return None

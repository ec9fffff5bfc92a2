"""config.yaml, which contains the configuration that repeats the run, and its version."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from crossgrad_core.config import RunConfig
from crossgrad_core.errors import UserError
from crossgrad_core.system.files import text_bytes, write_atomically
from crossgrad_core.system.version import VERSION
from crossgrad_core.system.yaml_values import read_mapping, write_yaml
from crossgrad_core.wording import listed

FILE = "config.yaml"
#: Settings that the file of every run contains.
_ALWAYS: Final = ("scene", "seed")
#: The key for the version of crossgrad that wrote a configuration, and the current version.
KEY: Final = "crossgrad"
CURRENT: Final = ".".join(VERSION.split(".")[:2])
#: The key of the notes, which are written with the settings.
NOTES: Final = "notes"


def write_config(folder: Path, config: RunConfig, notes: Sequence[str] = ()) -> None:
    """Write the configuration that repeats the run, and the notes of the run's start.

    A run with a time budget writes the file again when its length changes.
    """
    # Leave out `stop_after`, because the setting applies to one start of the run only.
    config = config.model_copy(update={"stop_after": None})
    noted = write_yaml({NOTES: list(notes)}) if notes else ""
    write_atomically(folder / FILE, text_bytes(f"{as_yaml(config)}{noted}"))


def read_config(folder: Path) -> dict[str, Any]:
    """Return the settings in a run's config.yaml.

    Raises:
        UserError: The file does not exist, so the folder is not a run; or the file is damaged or of
            another version.
    """
    path = folder / FILE
    if not path.is_file():
        raise UserError(
            "the folder is not the folder of a run",
            where=folder,
            expected=f"a folder that contains {FILE}",
            todo="name the folder that `crossgrad run` printed",
        )
    content = _content(folder)
    if gone := [name for name in _ALWAYS if name not in content]:
        raise UserError(
            f"{FILE} is incomplete",
            where=path,
            expected="all settings of the run",
            found=f"no {listed(gone)}",
            todo="restore the file from a copy; the results in the folder are unchanged",
        )
    return unmarked(content, path)


def read_notes(folder: Path) -> tuple[str, ...]:
    """Return the notes that a run wrote at its start."""
    notes = _content(folder).get(NOTES)
    return tuple(map(str, notes)) if isinstance(notes, list) else ()


def as_yaml(config: RunConfig) -> str:
    """Return the configuration as YAML text, with the version of crossgrad."""
    return write_yaml(marked(config.model_dump(mode="json")))


def _content(folder: Path) -> dict[str, Any]:
    return read_mapping(folder / FILE, "the configuration of the run", "start a new run")


def marked(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings with the version of crossgrad added."""
    return {KEY: CURRENT, **settings}


def unmarked(settings: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Return the settings of a file without version and notes; the version may be absent.

    Args:
        settings: The content of the file.
        path: The file.

    Raises:
        UserError: Another version of crossgrad wrote the file.
    """
    version = str(settings.get(KEY, CURRENT))
    if version != CURRENT:
        raise UserError(
            "the configuration was written by another version of crossgrad",
            where=f"{path}, {KEY}",
            expected=CURRENT,
            found=version,
            todo=f"install crossgrad {version}; or remove the line if the file is of this version",
        )
    return {name: value for name, value in settings.items() if name not in {KEY, NOTES}}

"""The version of crossgrad that a configuration file names."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from crossgrad_core.errors import UserError
from crossgrad_core.system.version import VERSION

#: The key that names the version that wrote a configuration, and the version of this one.
KEY: Final = "crossgrad"
CURRENT: Final = ".".join(VERSION.split(".")[:2])
#: The key of the notes, which are written with the settings.
NOTES: Final = "notes"


def marked(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings with the version that writes them."""
    return {KEY: CURRENT, **settings}


def unmarked(settings: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Return the settings of a file without version and notes; a file by hand names no version.

    Args:
        settings: The content of the file.
        path: The file.

    Raises:
        UserError: Another version of crossgrad wrote the file.
    """
    version = str(settings.get(KEY, CURRENT))
    if version != CURRENT:
        raise UserError(
            "the configuration is of another version of crossgrad",
            where=f"{path}, {KEY}",
            expected=CURRENT,
            found=version,
            todo=f"install crossgrad {version}, or remove the line if the file is of this version",
        )
    return {name: value for name, value in settings.items() if name not in {KEY, NOTES}}

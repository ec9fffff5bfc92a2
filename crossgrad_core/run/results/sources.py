"""Unique names for other scenes and camera paths, whose results are in a run's folder.

Two scenes or camera paths may have the same file name, but their results need different folders.
"""

from json import dumps
from pathlib import Path
from typing import Final

from crossgrad_core.system.files import text_bytes, write_atomically
from crossgrad_core.system.text_files import read_json

#: The file that maps the name of a scene or camera path to its path.
FILE: Final = "sources.json"
#: The name of the built-in camera path, which does not come from a file.
RESERVED: Final = ("zoom",)


def name_for(folder: Path, name: str, source: Path) -> str:
    """Return the name; add a number if the name already belongs to another source path.

    Args:
        folder: The run's folder, which stores the names.
        name: Name of the scene or camera path.
        source: Path of the scene or of the camera path's file.

    Raises:
        UserError: The disk is full.
    """
    source_by_name, source_path = _known(folder), str(source.resolve())
    taken, number = name, 1
    while taken in RESERVED or source_by_name.get(taken, source_path) != source_path:
        number += 1
        taken = f"{name}-{number}"
    if taken not in source_by_name:
        content = dumps({**source_by_name, taken: source_path}, indent=1, ensure_ascii=False)
        write_atomically(folder / FILE, text_bytes(f"{content}\n"))
    return taken


def _known(folder: Path) -> dict[str, str]:
    try:
        content = read_json(folder / FILE)
    except (FileNotFoundError, ValueError):
        return {}
    pairs = content.items() if isinstance(content, dict) else ()
    return {str(name): source_path for name, source_path in pairs if isinstance(source_path, str)}

"""The output of the command `crossgrad check`."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from crossgrad_core.commands import configured, merged, read_scene

#: Maximum number of notes that are printed.
_MOST: Final = 12


def lines_of(path: Path, assignments: Sequence[str]) -> list[str]:
    """Return the notes about a scene, warnings first, and the verdict.

    Args:
        path: The scene's folder.
        assignments: Texts `KEY=VALUE`, as after `--set`.

    Raises:
        UserError: The scene cannot be read, or its points, poses and photos contradict each other.
    """
    scene, reader = read_scene(configured(merged(None, {"scene": str(path)}, assignments)))
    results = scene.check or {}
    warnings = results.get("warnings")
    first = [str(warning) for warning in warnings] if isinstance(warnings, list) else []
    notes = [*first, *(note for note in scene.notes if note not in first)]
    more = [f"and {len(notes) - _MOST} more notes"] if len(notes) > _MOST else []
    return [*notes[:_MOST], *more, _verdict(results, len(scene.views), reader)]


def _verdict(results: Mapping[str, object], photos: int, reader: str) -> str:
    measured = {
        "correlation of colours": results.get("correlation"),
        "share of observed points inside the photos": results.get("in_frame"),
    }
    shown = [f"{name} {value:.2f}" for name, value in measured.items() if isinstance(value, float)]
    figures = f" (median {', '.join(shown)})" if shown else ""
    return (
        f"verdict: {results.get('verdict')}; {results.get('compared')} of {photos} photos compared "
        f"with the points, reader {reader}{figures}"
    )

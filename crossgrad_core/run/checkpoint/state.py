"""The JSON half of a checkpoint."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from crossgrad_core.errors import UserError
from crossgrad_core.run.checkpoint.folders import STATE, damaged
from crossgrad_core.system.version import VERSION

#: Version of the layout; raised whenever an older reader could misread a newer checkpoint.
FORMAT = 1


def state_text(state: Mapping[str, Any]) -> str:
    """The content of state.json: `state` and the versions that wrote it."""
    return json.dumps({"format": FORMAT, "crossgrad": VERSION, **state}, indent=1)


def check_json(value: object, where: str) -> None:
    """Refuses what JSON would change on the way: keys that are not text, tuples, arrays.

    Raises:
        UserError: Names the place and the culprit.
    """
    if isinstance(value, Mapping):
        for key, item in value.items():
            if not isinstance(key, str):
                raise _not_json(where, f"the key {key!r}")
            check_json(item, f"{where}, {key}")
    elif isinstance(value, list):
        for item in value:
            check_json(item, where)
    elif not isinstance(value, bool | int | float | str | None):
        raise _not_json(where, f"{value!r} of type {type(value).__name__}")


def read_state(folder: Path) -> dict[str, Any]:
    """The content of a checkpoint's state.json.

    Raises:
        UserError: The checkpoint is missing, damaged, or of another format version.
    """
    if not folder.is_dir():
        raise UserError(
            "no such checkpoint",
            where=folder,
            todo="name a folder below checkpoints/ in the folder of a run",
        )
    try:
        state = json.loads((folder / STATE).read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise damaged(folder, f"no {STATE}") from error
    except ValueError as error:
        raise damaged(folder, f"{STATE} is not JSON: {error}") from error
    if not isinstance(state, dict) or "format" not in state or "sha256" not in state:
        raise damaged(folder, f"{STATE} is not the state of a checkpoint")
    if state["format"] != FORMAT:
        raise UserError(
            "checkpoint of another format version",
            where=folder,
            expected=f"version {FORMAT} (crossgrad {VERSION})",
            found=f"version {state['format']} (crossgrad {state.get('crossgrad', '?')})",
            todo="continue with the version of crossgrad that wrote it",
        )
    return state


def _not_json(where: str, found: str) -> UserError:
    return UserError(
        "state that a checkpoint cannot hold",
        where=where,
        expected="numbers, strings, lists, dictionaries with text keys, None",
        found=found,
        todo="keep arrays as tensors in PluginState.tensors",
    )

"""The JSON half of a checkpoint."""

import json
from collections.abc import Callable, Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any

from crossgrad_core.errors import UserError
from crossgrad_core.run.checkpoint.folders import STATE, damaged
from crossgrad_core.system.text_files import read_json
from crossgrad_core.system.version import VERSION
from crossgrad_core.training.state import no_json

#: Version of the layout; raised whenever an older reader could misread a newer checkpoint.
FORMAT = 1
_DIGEST = "state_sha256"


def state_text(state: Mapping[str, Any]) -> str:
    """The content of state.json: `state`, the versions that wrote it, and a digest of all that."""
    rest = {key: value for key, value in state.items() if key != _DIGEST}
    whole = {"format": FORMAT, "crossgrad": VERSION, **rest}
    return json.dumps({_DIGEST: digest(whole), **whole}, indent=1)


def digest(state: Mapping[str, Any]) -> str:
    """SHA-256 of a state, its own digest left out; the same before and after JSON."""
    rest = {key: value for key, value in state.items() if key != _DIGEST}
    return sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


def check_json(value: object, where: str) -> None:
    """Refuses what JSON would change on the way: keys that are not text, tuples, arrays.

    Raises:
        UserError: Names the place and the culprit.
    """
    if wrong := no_json(value):
        raise UserError(
            "state that a checkpoint cannot hold",
            where=where,
            expected="numbers, strings, lists, dictionaries with text keys, None",
            found=wrong,
            todo="keep arrays as tensors in PluginState.tensors",
        )


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
        state = read_json(folder / STATE)
    except FileNotFoundError as error:
        raise damaged(folder, f"no {STATE}") from error
    except ValueError as error:
        raise damaged(folder, f"{STATE} is not JSON: {error}") from error
    if not isinstance(state, dict) or "format" not in state:
        raise damaged(folder, f"{STATE} is not the state of a checkpoint")
    if state["format"] != FORMAT:
        raise UserError(
            "checkpoint of another format version",
            where=folder,
            expected=f"version {FORMAT} (crossgrad {VERSION})",
            found=f"version {state['format']} (crossgrad {state.get('crossgrad', '?')})",
            todo="continue with the version of crossgrad that wrote it",
        )
    _check_whole(state, folder)
    return state


def _check_whole(state: Mapping[str, Any], folder: Path) -> None:
    """Refuses a state that is not what was written, as far as it says so itself.

    Raises:
        UserError: The digest differs, or something is missing or of another type.
    """
    # Runs of before there was a digest go on.
    if state.get(_DIGEST, digest(state)) != digest(state):
        raise damaged(folder, f"{STATE} is not what was written (its SHA-256 differs)")
    wrong = [name for name, holds in _PARTS.items() if not holds(state.get(name))]
    if wrong:
        raise damaged(folder, f"{STATE} lacks a valid {', '.join(wrong)}")


def _is_count(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _is_map(value: object) -> bool:
    return isinstance(value, dict)


#: What a state consists of, and how each part is known.
_PARTS: Mapping[str, Callable[[Any], bool]] = {
    "sha256": lambda value: isinstance(value, str),
    "step": _is_count,
    "tensors": lambda names: (
        isinstance(names, list) and all(isinstance(name, str) for name in names)
    ),
    "adam_steps": lambda steps: _is_map(steps) and all(map(_is_count, steps.values())),
    "scalars": _is_map,
    "generators": lambda states: _is_map(states) and all(map(_is_map, states.values())),
    "plugins": lambda states: _is_map(states) and all(map(_is_map, states.values())),
}

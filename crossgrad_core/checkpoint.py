"""Resumable checkpoints: safetensors and JSON in one folder, complete or not there at all.

<run>/checkpoints/step-000700/tensors.safetensors   parameters, moments, plugin tensors
<run>/checkpoints/step-000700/state.json            everything else, and the tensors' SHA-256
"""

import json
import re
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from hashlib import file_digest
from pathlib import Path
from typing import Any

from torch import Tensor

from crossgrad_core import __version__
from crossgrad_core.checkpoint_tensors import (
    pack,
    packed_bytes,
    read_tensors,
    unpack,
    write_tensors,
)
from crossgrad_core.errors import UserError
from crossgrad_core.files import disk_errors, sync_file, sync_folder
from crossgrad_core.state import Json, PluginState

#: Version of the layout; raised whenever an older reader could misread a newer checkpoint.
FORMAT = 1

TENSORS = "tensors.safetensors"
STATE = "state.json"

_FOLDER = "checkpoints"
_STEP = re.compile(r"step-(\d{6,})")
_SCRATCH = ".scratch-"


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """Everything from which a run continues bit for bit.

    Attributes:
        step: Steps done.
        parameters: Tensor name -> parameter.
        exp_avg: Tensor name -> Adam's first moment.
        exp_avg_sq: Tensor name -> Adam's second moment.
        adam_steps: Tensor name -> number of Adam steps taken.
        plugins: Plugin name -> its state.
        generators: Stream name -> `bit_generator.state` of its NumPy generator.
        scalars: Counters, clocks and whatever else survives JSON.
    """

    step: int
    parameters: Mapping[str, Tensor]
    exp_avg: Mapping[str, Tensor] = field(default_factory=dict)
    exp_avg_sq: Mapping[str, Tensor] = field(default_factory=dict)
    adam_steps: Mapping[str, int] = field(default_factory=dict)
    plugins: Mapping[str, PluginState] = field(default_factory=dict)
    generators: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    scalars: Mapping[str, Json] = field(default_factory=dict)


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


def save(run: Path, checkpoint: Checkpoint, keep: Keep | None = None) -> Path:
    """Writes a checkpoint below the run's folder and then deletes those not worth keeping.

    The new checkpoint gets its name when all of it is on the disk; until then, and after any
    failure, the earlier ones stay as they are.

    Returns:
        The checkpoint's folder.

    Raises:
        UserError: The disk is full or must not be written to, or a plugin's state is not JSON.
    """
    tensors = pack(checkpoint)
    text = _state_text(checkpoint)
    folder = run / _FOLDER
    final = folder / f"step-{checkpoint.step:06d}"
    scratch = folder / f"{_SCRATCH}{final.name}"
    with disk_errors(final, packed_bytes(tensors) + len(text)):
        folder.mkdir(parents=True, exist_ok=True)
        _clear_scratch(folder)
        try:
            scratch.mkdir()
            write_tensors(scratch / TENSORS, tensors)
            text = text.replace('"sha256": ""', f'"sha256": "{_digest(scratch / TENSORS)}"', 1)
            (scratch / STATE).write_text(text, encoding="utf-8")
            sync_file(scratch / STATE)
            sync_folder(scratch)
            _take_name(scratch, final)
        finally:
            _clear_scratch(folder)
        steps = _complete(folder)
        for step in (keep or Keep()).drops(list(steps)):
            _discard(steps[step])
    return final


def latest(run: Path) -> Path:
    """The newest complete checkpoint of a run.

    Args:
        run: The run's folder, its folder `checkpoints`, or one checkpoint.

    Raises:
        UserError: There is none.
    """
    if _is_complete(run):
        return run
    for folder in (run / _FOLDER, run):
        steps = _complete(folder)
        if steps:
            return steps[max(steps)]
    raise UserError(
        "no checkpoint to continue from",
        where=run,
        expected=f"the folder of a run with {_FOLDER}/step-.../{STATE} in it",
        found="a PLY file, which holds no optimizer state" if run.suffix == ".ply" else "",
        todo="name the folder of a run; use --init FILE.ply to start a new run from Gaussians",
    )


def load(folder: Path) -> Checkpoint:
    """Reads a checkpoint folder, tensors on the CPU, bit for bit as they were saved.

    Raises:
        UserError: It is missing, incomplete, damaged, or of another format version.
    """
    state = _read_state(folder)
    if not (folder / TENSORS).is_file():
        raise _damaged(folder, f"no {TENSORS}")
    if _digest(folder / TENSORS) != state["sha256"]:
        raise _damaged(folder, f"{TENSORS} is not what was written (its SHA-256 differs)")
    try:
        tensors = unpack(read_tensors(folder / TENSORS))
        return Checkpoint(
            step=state["step"],
            parameters=tensors.parameters,
            exp_avg=tensors.exp_avg,
            exp_avg_sq=tensors.exp_avg_sq,
            adam_steps=state["adam_steps"],
            plugins={
                name: PluginState(values, *tensors.plugin(name))
                for name, values in state["plugins"].items()
            },
            generators=state["generators"],
            scalars=state["scalars"],
        )
    except (KeyError, TypeError, ValueError) as error:
        raise _damaged(folder, f"{type(error).__name__}: {error}") from error


def _state_text(checkpoint: Checkpoint) -> str:
    for name, plugin in checkpoint.plugins.items():
        _check_json(plugin.values, f"plugin {name}")
    _check_json(checkpoint.scalars, "scalars")
    state = {
        "format": FORMAT,
        "crossgrad": __version__,
        "step": checkpoint.step,
        "sha256": "",
        "adam_steps": dict(checkpoint.adam_steps),
        "scalars": dict(checkpoint.scalars),
        "generators": {name: dict(rng) for name, rng in checkpoint.generators.items()},
        "plugins": {name: dict(plugin.values) for name, plugin in checkpoint.plugins.items()},
    }
    return json.dumps(state, indent=1)


def _check_json(value: object, where: str) -> None:
    """Refuses what JSON would change on the way: keys that are not text, tuples, arrays ..."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            if not isinstance(key, str):
                raise _not_json(where, f"the key {key!r}")
            _check_json(item, f"{where}, {key}")
    elif isinstance(value, list):
        for item in value:
            _check_json(item, where)
    elif not isinstance(value, bool | int | float | str | None):
        raise _not_json(where, f"{value!r} of type {type(value).__name__}")


def _not_json(where: str, found: str) -> UserError:
    return UserError(
        "state that a checkpoint cannot hold",
        where=where,
        expected="numbers, strings, lists, dictionaries with text keys, None",
        found=found,
        todo="keep arrays as tensors in PluginState.tensors",
    )


def _read_state(folder: Path) -> dict[str, Any]:
    if not folder.is_dir():
        raise UserError("no such checkpoint", where=folder)
    try:
        state = json.loads((folder / STATE).read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise _damaged(folder, f"no {STATE}") from error
    except ValueError as error:
        raise _damaged(folder, f"{STATE} is not JSON: {error}") from error
    if not isinstance(state, dict) or "format" not in state or "sha256" not in state:
        raise _damaged(folder, f"{STATE} is not the state of a checkpoint")
    if state["format"] != FORMAT:
        raise UserError(
            "checkpoint of another format version",
            where=folder,
            expected=f"version {FORMAT} (crossgrad {__version__})",
            found=f"version {state['format']} (crossgrad {state.get('crossgrad', '?')})",
            todo="continue with the version of crossgrad that wrote it",
        )
    return state


def _damaged(folder: Path, found: str) -> UserError:
    others = [path for path in _complete(folder.parent).values() if path.name != folder.name]
    return UserError(
        "damaged checkpoint",
        where=folder,
        found=found,
        todo=f"continue from {others[-1]}" if others else "start the run again",
    )


def _is_complete(folder: Path) -> bool:
    named = _STEP.fullmatch(folder.name) is not None
    return named and (folder / STATE).is_file() and (folder / TENSORS).is_file()


def _complete(folder: Path) -> dict[int, Path]:
    """Step -> folder of the complete checkpoints, in order of steps."""
    if not folder.is_dir():
        return {}
    found = [path for path in folder.iterdir() if _is_complete(path)]
    by_step = {int(path.name.removeprefix("step-")): path for path in found}
    return dict(sorted(by_step.items()))


def _take_name(scratch: Path, final: Path) -> None:
    """Gives the finished folder its name, also where an older one has it."""
    if final.exists():
        old = final.with_name(f"{_SCRATCH}old-{final.name}")
        final.rename(old)
    scratch.rename(final)
    sync_folder(final.parent)


def _discard(folder: Path) -> None:
    """Deletes a checkpoint so that half of one never looks complete."""
    doomed = folder.with_name(f"{_SCRATCH}old-{folder.name}")
    folder.rename(doomed)
    shutil.rmtree(doomed)


def _clear_scratch(folder: Path) -> None:
    """Deletes what an interrupted run left half-written."""
    for path in folder.glob(f"{_SCRATCH}*"):
        shutil.rmtree(path, ignore_errors=True)


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return file_digest(file, "sha256").hexdigest()

"""Resumable checkpoints: safetensors and JSON in one folder, which is either complete or absent.

<run>/checkpoints/step-000700/tensors.safetensors   parameters, moments, plugin tensors
<run>/checkpoints/step-000700/state.json            everything else, and the tensors' SHA-256
"""

import json
import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

from torch import Tensor

from crossgrad_core.contract.blocks import Json, PluginState
from crossgrad_core.errors import UserError
from crossgrad_core.system.checksums import digest_of
from crossgrad_core.system.files import (
    disk_errors,
    is_full,
    sync_file,
    sync_folder,
    write_atomically,
)
from crossgrad_core.system.text_files import read_json
from crossgrad_core.system.version import VERSION
from crossgrad_core.training.state import no_json
from crossgrad_core.wording import showable


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """The complete state of a run, from which the run continues with bitwise equal results.

    Attributes:
        step: Number of completed steps.
        parameters: Tensor name -> parameter.
        exp_avg: Tensor name -> Adam's first moment.
        exp_avg_sq: Tensor name -> Adam's second moment.
        adam_steps: Tensor name -> number of Adam steps taken.
        plugins: Plugin name -> state of the plugin.
        generators: Stream name -> `bit_generator.state` of its NumPy generator.
        scalars: Counters, clocks and other values that JSON can store (tuples become lists).
    """

    step: int
    parameters: Mapping[str, Tensor]
    exp_avg: Mapping[str, Tensor] = field(default_factory=dict)
    exp_avg_sq: Mapping[str, Tensor] = field(default_factory=dict)
    adam_steps: Mapping[str, int] = field(default_factory=dict)
    plugins: Mapping[str, PluginState] = field(default_factory=dict)
    generators: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    scalars: Mapping[str, Json] = field(default_factory=dict)


CHECKPOINTS = "checkpoints"
TENSORS = "tensors.safetensors"
STATE = "state.json"
_STEP = re.compile(r"step-(\d{6,})")
_SCRATCH = ".scratch-"


@dataclass(frozen=True)
class Keep:
    """The rule that decides which older checkpoints are kept when a new one is written.

    Attributes:
        last: Number of newest checkpoints that are kept, including the new one.
        every: Checkpoints at multiples of this step are kept, too; None keeps only the newest
            checkpoints.
    """

    last: int = 2
    every: int | None = None

    def drops(self, steps: list[int]) -> list[int]:
        """Return the members of `steps` whose checkpoints are to be deleted."""
        old = sorted(steps)[: -self.last]
        return [step for step in old if self.every is None or step % self.every]


def is_checkpoint(folder: Path) -> bool:
    """Return True for the folder of a checkpoint, even if some of its files are lost."""
    return _STEP.fullmatch(folder.name) is not None and folder.is_dir()


def is_complete(folder: Path) -> bool:
    """Return True if all files of a checkpoint exist."""
    return (folder / STATE).is_file() and (folder / TENSORS).is_file()


def named_checkpoints(folder: Path) -> dict[int, Path]:
    """Return step -> folder of the checkpoints in `folder`, in the order of steps.

    A checkpoint gets its final name when all of its files are written. A checkpoint with a missing
    file is therefore damaged. A damaged checkpoint is still returned, because otherwise a run would
    silently continue from an older checkpoint.
    """
    if not folder.is_dir():
        return {}
    folders = [path for path in folder.iterdir() if is_checkpoint(path)]
    by_step = {int(path.name.removeprefix("step-")): path for path in folders}
    return dict(sorted(by_step.items()))


def damaged(folder: Path, found: str) -> UserError:
    """Return the error for a damaged checkpoint; name a complete checkpoint if one exists."""
    named = named_checkpoints(folder.parent).values()
    others = [path for path in named if path.name != folder.name and is_complete(path)]
    return UserError(
        "the checkpoint is damaged",
        where=folder,
        found=found,
        todo=f"remove this folder; the run then continues from {others[-1].name}"
        if others
        else "start the run again",
    )


@contextmanager
def scratch_folder(final: Path) -> Iterator[Path]:
    """Yield a temporary folder, which is renamed to `final` if the block ends without an error."""
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
    """Delete a checkpoint so that a partly deleted folder never looks complete."""
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
    """Delete the half-written folders of this run or of an interrupted run."""
    for path in folder.glob(f"{_SCRATCH}*"):
        shutil.rmtree(path, ignore_errors=True)


#: Version of the file layout. Increase this number if older code could misread a newer checkpoint.
FORMAT = 1
_DIGEST = "state_sha256"


def state_text(state: Mapping[str, Any]) -> str:
    """Return the content of state.json: `state`, the format, the version and a digest."""
    rest = {key: value for key, value in state.items() if key != _DIGEST}
    whole = {"format": FORMAT, "crossgrad": VERSION, **rest}
    return json.dumps({_DIGEST: digest(whole), **whole}, indent=1)


def digest(state: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a state without its digest; the state may come from a JSON file."""
    rest = {key: value for key, value in state.items() if key != _DIGEST}
    return sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


def check_json(value: object, where: str) -> None:
    """Refuse values that JSON would change: keys that are not text, tuples and arrays.

    Raises:
        UserError: JSON would change a value; the message names the position of the value.
    """
    if wrong := no_json(value):
        raise UserError(
            "a plugin's state contains values that a checkpoint cannot hold",
            where=where,
            expected="numbers, strings, lists, dictionaries with text keys, None",
            found=wrong,
            todo="store arrays as tensors in PluginState.tensors",
        )


def read_state(folder: Path) -> dict[str, Any]:
    """Return the content of a checkpoint's state.json.

    Raises:
        UserError: The checkpoint is missing, damaged, or of another format version.
    """
    if not folder.is_dir():
        raise UserError(
            "the checkpoint does not exist",
            where=folder,
            todo="name a folder in checkpoints/ of a run",
        )
    try:
        state = read_json(folder / STATE)
    except FileNotFoundError as error:
        raise damaged(folder, f"no {STATE}") from error
    except ValueError as error:
        raise damaged(folder, f"{STATE} is not valid JSON: {error}") from error
    if not isinstance(state, dict) or "format" not in state:
        raise damaged(folder, f"{STATE} does not contain the state of a checkpoint")
    if state["format"] != FORMAT:
        raise UserError(
            "the checkpoint was written in another format version",
            where=folder,
            expected=f"version {FORMAT} (crossgrad {VERSION})",
            found=f"version {state['format']} (crossgrad {state.get('crossgrad', '?')})",
            todo="resume with the version of crossgrad that wrote the checkpoint",
        )
    _check_whole(state, folder)
    return state


def _check_whole(state: Mapping[str, Any], folder: Path) -> None:
    """Refuse a state that differs from the state that was written.

    Raises:
        UserError: The digest differs, or a part is missing or of another type.
    """
    if state.get(_DIGEST) != digest(state):
        raise damaged(folder, f"{STATE} has changed since it was written (its SHA-256 differs)")
    wrong = [name for name, holds in _PARTS.items() if not holds(state.get(name))]
    if wrong:
        raise damaged(folder, f"{STATE} has no valid {', '.join(wrong)}")


def _is_count(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _is_map(value: object) -> bool:
    return isinstance(value, dict)


#: Part of a state -> function that tests whether its value is valid.
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
_PLUGIN = "plugin"
_SYSTEM_ERROR = re.compile(r"\(os error (\d+)\)")


@dataclass
class Unpacked:
    """The tensors of a checkpoint file, sorted by owner."""

    parameters: dict[str, Tensor] = field(default_factory=dict)
    exp_avg: dict[str, Tensor] = field(default_factory=dict)
    exp_avg_sq: dict[str, Tensor] = field(default_factory=dict)
    plugins: dict[str, dict[str, dict[str, Tensor]]] = field(default_factory=dict)

    def plugin(self, name: str) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Return `tensors` and `per_primitive` of a plugin's state."""
        kinds = self.plugins.get(name, {})
        return kinds.get("tensors", {}), kinds.get("per_primitive", {})


def pack(checkpoint: "Checkpoint") -> dict[str, Tensor]:
    """Return key -> contiguous CPU tensor; no two tensors share memory."""
    packed: dict[str, Tensor] = {}
    storages: set[int] = set()
    for path, tensor in _all(checkpoint):
        owned = tensor.detach().cpu().contiguous()
        storage = owned.untyped_storage()
        partial = storage.nbytes() != owned.numel() * owned.element_size()
        # Clone the tensor, because safetensors refuses tensors that share memory.
        if partial or storage.data_ptr() in storages:
            owned = owned.clone()
        storages.add(owned.untyped_storage().data_ptr())
        packed["/".join(quote(part, safe="") for part in path)] = owned
    return packed


def packed_bytes(tensors: Mapping[str, Tensor]) -> int:
    """Return the size of the tensors in bytes."""
    return sum(tensor.numel() * tensor.element_size() for tensor in tensors.values())


def unpack(packed: Mapping[str, Tensor]) -> Unpacked:
    """Return the tensors by owner; the inverse of `pack`.

    Raises:
        ValueError: A key does not have the form of the keys that `pack` writes.
    """
    tensors = Unpacked()
    for key, tensor in packed.items():
        match [unquote(part) for part in key.split("/")]:
            case ["parameters", name]:
                tensors.parameters[name] = tensor
            case ["exp_avg", name]:
                tensors.exp_avg[name] = tensor
            case ["exp_avg_sq", name]:
                tensors.exp_avg_sq[name] = tensor
            case ["plugin", plugin, ("tensors" | "per_primitive") as kind, name]:
                tensors.plugins.setdefault(plugin, {}).setdefault(kind, {})[name] = tensor
            case _:
                message = f"unknown tensor {key!r}"
                raise ValueError(message)
    return tensors


def write_tensors(path: Path, packed: dict[str, Tensor]) -> None:
    """Write a safetensors file and wait until it is on the disk.

    Raises:
        OSError: The file cannot be written, for example because the disk is full. A system error
            that the library wraps in its own exception is also raised as OSError.
    """
    from safetensors import SafetensorError
    from safetensors.torch import save_file

    try:
        path.touch()
        mode = path.stat().st_mode
        save_file(packed, path)
        # Restore the permissions, because safetensors creates a file that only its owner may read.
        path.chmod(mode)
        sync_file(path)
    except SafetensorError as error:
        number = _SYSTEM_ERROR.search(str(error))
        if number is None:
            raise
        raise OSError(int(number.group(1)), str(error)) from error


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Read a safetensors file into newly allocated memory.

    Raises:
        ValueError: The file is not a readable safetensors file.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load, load_file

    try:
        # Read the bytes directly, because safetensors opens only files whose names are valid UTF-8.
        if showable(str(path)) != str(path):
            return load(path.read_bytes())
        # Clone the tensors, because safetensors maps the file and a later checkpoint may delete the
        # file.
        return {key: tensor.clone() for key, tensor in load_file(path).items()}
    except SafetensorError as error:
        raise ValueError(str(error)) from error


def _all(checkpoint: "Checkpoint") -> Iterator[tuple[tuple[str, ...], Tensor]]:
    """Yield the key of every tensor of a checkpoint, as a tuple of names, and the tensor."""
    for kind in ("parameters", "exp_avg", "exp_avg_sq"):
        tensors: Mapping[str, Tensor] = getattr(checkpoint, kind)
        for name, tensor in tensors.items():
            yield (kind, name), tensor
    for plugin, state in checkpoint.plugins.items():
        for name, tensor in state.tensors.items():
            yield (_PLUGIN, plugin, "tensors", name), tensor
        for name, tensor in state.per_primitive.items():
            yield (_PLUGIN, plugin, "per_primitive", name), tensor


def save(run: Path, checkpoint: Checkpoint, keep: Keep | None = None) -> Path:
    """Write a checkpoint below the run's folder, then delete the checkpoints that `keep` drops.

    The new checkpoint gets its final name when all its files are on the disk. Until then, and after
    any failure, the earlier checkpoints are not changed.

    Args:
        run: The run's folder.
        checkpoint: The checkpoint, with tensors on any device.
        keep: The rule for older checkpoints; by default the two newest checkpoints are kept.

    Returns:
        The checkpoint's folder.

    Raises:
        UserError: The disk is full or not writable, or a plugin's state is not JSON.
    """
    tensors = pack(checkpoint)
    state = _plain_state(checkpoint, list(tensors))
    for name, plugin in checkpoint.plugins.items():
        check_json(dict(plugin.values), f"plugin {name}")
    final = run / CHECKPOINTS / f"step-{checkpoint.step:06d}"
    keep = keep or Keep()
    with disk_errors(final, packed_bytes(tensors)):
        try:
            _write(final, tensors, state)
        except OSError as error:
            # The disk is full. Delete the checkpoints that are no longer kept, which may free
            # enough space. The newest checkpoint is kept.
            if not is_full(error) or not _drop(final.parent, keep, checkpoint.step):
                raise
            _write(final, tensors, state)
        _drop(final.parent, keep)
    return final


def _write(final: Path, tensors: dict[str, Tensor], state: Mapping[str, Any]) -> None:
    with scratch_folder(final) as scratch:
        write_tensors(scratch / TENSORS, tensors)
        text = state_text({"sha256": digest_of(scratch / TENSORS), **state})
        (scratch / STATE).write_text(text, encoding="utf-8")
        sync_file(scratch / STATE)


def _drop(folder: Path, keep: Keep, *coming: int) -> bool:
    """Delete the checkpoints that `keep` drops; the steps `coming` count as existing checkpoints.

    Return True if a checkpoint was deleted.
    """
    steps = named_checkpoints(folder)
    doomed = [steps[step] for step in keep.drops([*steps, *coming]) if step in steps]
    for checkpoint in doomed:
        discard(checkpoint)
    return bool(doomed)


def load_latest(run: Path) -> Checkpoint:
    """Read the newest checkpoint of a run, even if the run deletes checkpoints during the call.

    Raises:
        UserError: There is no checkpoint, or the newest checkpoint is damaged.
    """
    while True:
        folder = latest(run)
        try:
            return load(folder)
        except (UserError, OSError):
            if folder.is_dir():
                raise


def latest(run: Path) -> Path:
    """Return the newest checkpoint of a run, complete or damaged.

    Args:
        run: The run's folder, its folder `checkpoints`, or one checkpoint.

    Raises:
        UserError: There is no checkpoint.
    """
    if is_checkpoint(run):
        return run
    for folder in (run / CHECKPOINTS, run):
        steps = named_checkpoints(folder)
        if steps:
            return steps[max(steps)]
    raise UserError(
        "there is no checkpoint to resume from",
        where=run,
        expected=f"the folder of a run that contains {CHECKPOINTS}/step-.../{STATE}",
        found="a PLY file, which holds no optimizer state" if run.suffix == ".ply" else "",
        todo="name the folder of a run; use --init FILE.ply to start a new run from Gaussians",
    )


def drop_later(run: Path, step: int) -> None:
    """Delete checkpoints after `step`, because a run resumed at `step` would not reproduce them."""
    for later, folder in named_checkpoints(run / CHECKPOINTS).items():
        if later > step:
            discard(folder)


def load(folder: Path) -> Checkpoint:
    """Return the checkpoint in a folder, with bitwise unchanged tensors on the CPU.

    Raises:
        UserError: The checkpoint is missing, incomplete, damaged, or of another format version.
    """
    state = read_state(folder)
    if not (folder / TENSORS).is_file():
        raise damaged(folder, f"no {TENSORS}")
    if digest_of(folder / TENSORS) != state["sha256"]:
        raise damaged(folder, f"{TENSORS} has changed since it was written (its SHA-256 differs)")
    try:
        packed = read_tensors(folder / TENSORS)
        # Restore the order of the parameters, because safetensors sorts the tensors by key.
        tensors = unpack({key: packed[key] for key in state["tensors"]})
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
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise damaged(folder, f"{type(error).__name__}: {error}") from error


def renew_scalars(folder: Path, scalars: Mapping[str, Json]) -> None:
    """Replace some scalars of a checkpoint on the disk.

    Raises:
        UserError: The checkpoint is damaged, or the disk is full.
    """
    state = read_state(folder)
    text = state_text({**state, "scalars": {**state["scalars"], **scalars}})
    write_atomically(folder / STATE, text.encode())


def _plain_state(checkpoint: Checkpoint, tensors: list[str]) -> dict[str, Any]:
    return {
        "step": checkpoint.step,
        "tensors": tensors,
        "adam_steps": dict(checkpoint.adam_steps),
        "scalars": dict(checkpoint.scalars),
        "generators": {name: dict(rng) for name, rng in checkpoint.generators.items()},
        "plugins": {name: dict(plugin.values) for name, plugin in checkpoint.plugins.items()},
    }

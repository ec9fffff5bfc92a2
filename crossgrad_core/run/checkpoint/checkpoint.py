"""Resumable checkpoints: safetensors and JSON in one folder, complete or not there at all.

<run>/checkpoints/step-000700/tensors.safetensors   parameters, moments, plugin tensors
<run>/checkpoints/step-000700/state.json            everything else, and the tensors' SHA-256
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from crossgrad_core.contract.state import Json, PluginState
from crossgrad_core.errors import UserError
from crossgrad_core.run.checkpoint.contents import Checkpoint
from crossgrad_core.run.checkpoint.folders import (
    CHECKPOINTS,
    STATE,
    TENSORS,
    Keep,
    damaged,
    discard,
    is_checkpoint,
    named_checkpoints,
    scratch_folder,
)
from crossgrad_core.run.checkpoint.state import check_json, read_state, state_text
from crossgrad_core.run.checkpoint.tensors import (
    pack,
    packed_bytes,
    read_tensors,
    unpack,
    write_tensors,
)
from crossgrad_core.system.checksums import digest_of
from crossgrad_core.system.files import disk_errors, is_full, sync_file, write_atomically


def save(run: Path, checkpoint: Checkpoint, keep: Keep | None = None) -> Path:
    """Writes a checkpoint below the run's folder and then deletes those not worth keeping.

    The new checkpoint gets its name when all of it is on the disk; until then, and after any
    failure, the earlier ones stay as they are.

    Args:
        run: The run's folder.
        checkpoint: What to save; tensors on any device.
        keep: Which checkpoints survive; the last two where not given.

    Returns:
        The checkpoint's folder.

    Raises:
        UserError: The disk is full or must not be written to, or a plugin's state is not JSON.
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
            # Those that would go afterwards may make the room; the newest of them all stays.
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
    """Deletes the checkpoints not worth keeping beside those that are coming; whether any was."""
    steps = named_checkpoints(folder)
    doomed = [steps[step] for step in keep.drops([*steps, *coming]) if step in steps]
    for each in doomed:
        discard(each)
    return bool(doomed)


def load_latest(run: Path) -> Checkpoint:
    """Reads the newest checkpoint of a run, which may be training and deletes old ones meanwhile.

    Raises:
        UserError: There is none, or it is damaged.
    """
    while True:
        folder = latest(run)
        try:
            return load(folder)
        except (UserError, OSError):
            if folder.is_dir():
                raise


def latest(run: Path) -> Path:
    """Return the newest checkpoint of a run, whole or damaged.

    Args:
        run: The run's folder, its folder `checkpoints`, or one checkpoint.

    Raises:
        UserError: There is none.
    """
    if is_checkpoint(run):
        return run
    for folder in (run / CHECKPOINTS, run):
        steps = named_checkpoints(folder)
        if steps:
            return steps[max(steps)]
    raise UserError(
        "no checkpoint to continue from",
        where=run,
        expected=f"the folder of a run with {CHECKPOINTS}/step-.../{STATE} in it",
        found="a PLY file, which holds no optimizer state" if run.suffix == ".ply" else "",
        todo="name the folder of a run; use --init FILE.ply to start a new run from Gaussians",
    )


def drop_later(run: Path, step: int) -> None:
    """Deletes checkpoints beyond `step`, from which a resumed run would no longer follow."""
    for later, folder in named_checkpoints(run / CHECKPOINTS).items():
        if later > step:
            discard(folder)


def load(folder: Path) -> Checkpoint:
    """Reads a checkpoint folder: on the CPU, without gradients, bit for bit as it was saved.

    Raises:
        UserError: It is missing, incomplete, damaged, or of another format version.
    """
    state = read_state(folder)
    if not (folder / TENSORS).is_file():
        raise damaged(folder, f"no {TENSORS}")
    if digest_of(folder / TENSORS) != state["sha256"]:
        raise damaged(folder, f"{TENSORS} is not what was written (its SHA-256 differs)")
    try:
        packed = read_tensors(folder / TENSORS)
        # The library sorts by key; the order of parameters must survive too.
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
        UserError: It is damaged, or the disk is full.
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

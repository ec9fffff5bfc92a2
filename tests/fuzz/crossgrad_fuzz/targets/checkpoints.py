"""Checkpoints: tensors, state and what a run continues from."""

import hashlib
import json
import random
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import torch

from crossgrad_core.contract.blocks import AdamState, Block, LearningRate, PluginState
from crossgrad_core.contract.contexts import StepRecord
from crossgrad_core.errors import UserError
from crossgrad_core.run import checkpoint, load_run
from crossgrad_core.run.checkpoint import (
    STATE,
    TENSORS,
    Checkpoint,
    digest,
    latest,
    load,
    save,
)
from crossgrad_core.run.load_run import from_checkpoint, to_checkpoint
from crossgrad_core.system import text_files
from crossgrad_core.training import rngs
from crossgrad_core.training.rngs import make_streams
from crossgrad_core.training.state import TrainState
from crossgrad_fuzz.case import Case
from crossgrad_fuzz.case import load as load_case
from crossgrad_fuzz.mutate import NUMBERS, matcher
from crossgrad_fuzz.target import Target

#: What reads a checkpoint into a run.
_READS = {
    *("settings_of", "from_checkpoint", "check_settings", "_restored", "_clock", "_figures"),
    *("_check_tensors", "_misfit", "_record"),
}
_FOLDER = "checkpoints/step-000007"
_STATE, _TENSORS = f"{_FOLDER}/{STATE}", f"{_FOLDER}/{TENSORS}"
_BLOCKS = (
    Block("means", ("means",), True, "geometry", LearningRate(0.1)),
    Block("scales", ("scales",), True, "geometry", LearningRate(0.1)),
    Block("levels", ("levels",), True, "geometry", LearningRate(0.0)),
)
#: As much of a run as a checkpoint is held against.
_SETUP = cast(
    "Any",
    SimpleNamespace(
        blocks=_BLOCKS,
        trained_blocks=_BLOCKS[:1],
        device=torch.device("cpu"),
        config=SimpleNamespace(seed=0),
        per_photo=False,
    ),
)


def _state(*, full: bool) -> TrainState:
    parameters = {"means": torch.ones(2, 3), "scales": torch.zeros(2, 1)}
    parameters["levels"] = torch.arange(2)  # frozen, and whole numbers
    moments = {"means": torch.full((2, 3), 0.5)} if full else {}
    record = StepRecord(
        step=7,
        views=(0, 1),
        names=("a", "b"),
        losses=(0.5, 0.25),
        labels=("near", "far"),
        primitives=2,
        counts={},
        train_seconds=1.5,
    )
    plugin = PluginState({"queue": [1, 2]}, {"order": torch.arange(3)}, {"seen": torch.ones(2)})
    return TrainState(
        tensors=parameters,
        moments=AdamState(dict(moments), dict(moments), dict.fromkeys(moments, 7)),
        rngs=make_streams(0),
        states={"near-far/x": plugin} if full else {},
        step=7,
        last=record if full else None,
    )


@cache
def _seeds() -> Sequence[Case]:
    cases = []
    for full in (True, False):
        with tempfile.TemporaryDirectory() as place:
            save(Path(place), to_checkpoint(_state(full=full)))
            cases.append(load_case(Path(place)))
    return cases


def _parse(folder: Path) -> None:
    _say_what_is_missing(folder)
    found: Checkpoint = load(latest(latest(folder)))
    for tensors in (found.parameters, found.exp_avg, found.exp_avg_sq):
        assert all(isinstance(tensor, torch.Tensor) for tensor in tensors.values())
    state = from_checkpoint(_SETUP, found)
    assert state.step == found.step >= 0
    assert state.parameters["means"].shape[0] == state.parameters["scales"].shape[0]
    assert all(isinstance(value, int | float) for value in _seconds(state))
    assert all(0 <= rng.random() < 1 for rng in state.rngs.values())


def _seconds(state: TrainState) -> Iterator[object]:
    """Every number of the clock, those of its phases included."""
    for value in vars(state.clock).values():
        yield from value.values() if isinstance(value, dict) else (value,)


def _say_what_is_missing(folder: Path) -> None:
    state, tensors = (folder / _STATE).is_file(), (folder / _TENSORS).is_file()
    if not state and not tensors:
        with suppress(UserError):
            latest(folder / "gone")
        load(folder / "gone")
    if not state or not tensors:
        load(folder / _FOLDER)


def _repair(case: dict[str, bytes], rng: random.Random) -> dict[str, bytes]:
    """Makes the digests right again, most of the time."""
    if rng.random() < 0.3:
        return case
    try:
        state = json.loads(case.get(_STATE, b""))
        if rng.random() < 0.9:
            state["sha256"] = hashlib.sha256(case.get(_TENSORS, b"")).hexdigest()
        if "state_sha256" in state:
            state["state_sha256"] = digest(state)
        return {**case, _STATE: json.dumps(state, indent=1).encode()}
    except (ValueError, TypeError, RecursionError):
        return case


def _header(data: bytes, rng: random.Random) -> bytes:
    """Another number or word in the header of the tensors, whose length stays right."""
    length = int.from_bytes(data[:8], "little")
    header = data[8 : 8 + length]
    if len(header) != length or not header.startswith(b"{"):
        return data
    change = rng.choice(
        (
            matcher(rb"(\d+)", (*NUMBERS[:40], b"2", b"3", b"[]")),
            matcher(rb'"dtype":"(\w+)"', (b"F64", b"I32", b"I64", b"BOOL", b"U8", b"F8_E4M3")),
            matcher(rb'"([\w/%-]+)":\{', (b"parameters/means", b"plugin/a/tensors/b", b"x", b"")),
            matcher(rb'"shape":(\[[\d,]*\])', (b"[]", b"[0]", b"[3,2]", b"[1,2]", b"[-1]")),
        )
    )
    changed = change(header, rng)
    return len(changed).to_bytes(8, "little") + changed + data[8 + length :]


def _renamed(case: dict[str, bytes], rng: random.Random) -> dict[str, bytes]:
    """One tensor has another name, in both files."""
    old, new = rng.choice(_KEYS), rng.choice((*_KEYS, b"x", b"plugin/a", b"exp_avg/levels", b""))
    data, changed = case.get(_TENSORS, b""), dict(case)
    length = int.from_bytes(data[:8], "little")
    header = data[8 : 8 + length].replace(b'"%s"' % old, b'"%s"' % new)
    changed[_TENSORS] = len(header).to_bytes(8, "little") + header + data[8 + length :]
    changed[_STATE] = case.get(_STATE, b"").replace(b'"%s"' % old, b'"%s"' % new)
    return changed


_KEYS = (
    *(b"parameters/means", b"parameters/scales", b"parameters/levels", b"exp_avg/means"),
    *(b"exp_avg_sq/means", b"plugin/near-far%2Fx/tensors/order"),
)

TARGET = Target(
    name="checkpoint",
    seeds=_seeds,
    parse=_parse,
    parser={
        checkpoint: (
            *("save", "_write", "_drop", "drop_later", "load_latest", "_plain_state"),
            *("Keep", "scratch_folder", "discard", "_take_name", "_clear"),
            *("state_text", "check_json", "pack", "packed_bytes", "write_tensors", "_all"),
        ),
        load_run: tuple(name for name in vars(load_run) if name not in _READS),
        rngs: ("make_streams", "stream_states"),
        text_files: ("read_rows", "parse_number"),
    },
    words=(
        *(b'"step": ', b'"plugins": {}', b'"tensors": []', b"null", b"true", b"[]", b"{}", b"NaN"),
        *(b"parameters/means", b"parameters/scales", b"exp_avg/means", b"plugin/a/tensors/b"),
        *(b'"generators"', b'"scalars"', b'"last"', b'"clock"', b'"counters"', b"[" * 3000),
    ),
    mutators=(
        _header,
        matcher(rb": *(-?[\d.]+)", NUMBERS),
        matcher(rb": *(-?[\d.]+)", (b"null", b'"x"', b"[]", b"-1", b"true", b"1.5")),
        matcher(rb'("[\w ]+"): ', (b'"x"', b'"step"', b'"means"', b"3")),
        matcher(rb': *("[^"]*")', (b'"x"', b"3", b"null", b"[]", b"{}")),
        matcher(rb"(\[[^\[\]]*\])", (b"[]", b"{}", b"null", b"3")),
        matcher(rb"(\{[^{}]*\})", (b"{}", b"[]", b"null", b"3")),
    ),
    case_mutators=(_renamed,),
    repair=_repair,
)
TARGETS = (TARGET,)

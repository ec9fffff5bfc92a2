"""Named random streams: each purpose has its own generator, so that draws stay independent."""

from collections.abc import Iterable, Mapping
from typing import Any, cast
from zlib import crc32

import numpy as np

STREAMS = (
    "create", "grouping", "sampler", "operator", "densifier", "after_step", "regularize",
    "background", "resolution", "density",
)  # fmt: skip


def make_streams(
    seed: int, rewinds: int = 0, names: Iterable[str] = STREAMS
) -> dict[str, np.random.Generator]:
    """Return new generators for a run. After each rollback of training, the generators differ.

    Args:
        seed: Random seed of the run.
        rewinds: Number of rollbacks of training so far.
        names: Names of the streams. A run uses `STREAMS` and one stream for each rule.
    """
    return {name: np.random.default_rng([seed, crc32(name.encode()), rewinds]) for name in names}


def stream_states(streams: Mapping[str, np.random.Generator]) -> dict[str, dict[str, Any]]:
    """Return the states of all generators as plain data."""
    return {name: dict(rng.bit_generator.state) for name, rng in streams.items()}


def restored_streams(states: Mapping[str, Mapping[str, Any]]) -> dict[str, np.random.Generator]:
    """Return generators that continue from `states`.

    Raises:
        KeyError: A stream is missing.
        TypeError: A state is not a NumPy generator state.
        ValueError: A state is not a NumPy generator state.
    """
    absent = [name for name in STREAMS if name not in states]
    if absent:
        raise KeyError(*absent)
    streams = {}
    for name, state in states.items():
        rng = np.random.default_rng(0)
        rng.bit_generator.state = cast("Any", state)
        streams[name] = rng
    return streams

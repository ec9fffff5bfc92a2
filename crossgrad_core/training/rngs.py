"""Named random streams: one generator per purpose, so that one draw never shifts other draws."""

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
    """Return new generators of a run; each rewind of training gives different generators.

    Args:
        seed: Seed of the run.
        rewinds: How often training was rewound.
        names: Names of the streams: the streams of every run, and one for each rule.
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

"""Numbers that an operator remembers for each Gramian between steps."""

from collections.abc import Iterator
from itertools import groupby

import numpy as np
import torch
from numpy.typing import NDArray

from crossgrad_core.operator import OperatorContext
from crossgrad_core.state import PluginState


def recall(
    state: PluginState, context: OperatorContext, key: str, shape: tuple[int, ...]
) -> NDArray[np.float64]:
    """[B, *shape] what was remembered under `key`; zeros at first and where the shape changed."""
    parts = []
    for name, rows in _runs(context):
        where = f"{key}/{name}"
        stored = state.per_primitive if rows > 1 else state.tensors
        kept = stored.get(where)
        if kept is not None and kept.shape == (rows, *shape):
            parts.append(kept.cpu().numpy().astype(np.float64))
        else:
            parts.append(np.zeros((rows, *shape)))
    return np.concatenate(parts) if parts else np.zeros((0, *shape))


def remember(
    state: PluginState, context: OperatorContext, key: str, values: NDArray[np.float64]
) -> PluginState:
    """The state with `values` [B, ...] under `key`; rows of primitives move with the primitives."""
    tensors, rows_of = dict(state.tensors), dict(state.per_primitive)
    first = 0
    for name, rows in _runs(context):
        part = torch.from_numpy(values[first : first + rows].copy())
        (rows_of if rows > 1 else tensors)[f"{key}/{name}"] = part
        first += rows
    return PluginState(state.values, tensors, rows_of)


def _runs(context: OperatorContext) -> Iterator[tuple[str, int]]:
    """Names of blocks with the number of their Gramians: above 1 they are rows of primitives."""
    for name, run in groupby(context.blocks):
        yield name, sum(1 for _ in run)

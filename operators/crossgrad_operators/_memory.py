"""Numbers that an operator remembers for each Gramian between steps."""

from collections.abc import Iterator
from itertools import groupby

import numpy as np
import torch
from numpy.typing import NDArray

from crossgrad_core.plugin import OperatorContext, PluginState

#: More Gramians than this are those of primitives.
_BLOCKS = 64


def recall(
    state: PluginState, context: OperatorContext, key: str, shape: tuple[int, ...]
) -> NDArray[np.float64]:
    """[B, *shape] what was remembered under `key`; zeros at first and where the shape changed."""
    if _by_block(context):
        return _known(state.tensors.get(key), (len(context.blocks), *shape))
    parts = []
    for name, rows in _runs(context):
        stored = state.per_primitive if rows > 1 else state.tensors
        parts.append(_known(stored.get(f"{key}/{name}"), (rows, *shape)))
    return np.concatenate(parts) if parts else np.zeros((0, *shape))


def remember(
    state: PluginState, context: OperatorContext, key: str, values: NDArray[np.float64]
) -> PluginState:
    """The state with `values` [B, ...] under `key`; rows of primitives move with the primitives."""
    tensors, rows_of = dict(state.tensors), dict(state.per_primitive)
    if _by_block(context):
        tensors[key] = torch.from_numpy(values)
        return PluginState(state.values, tensors, rows_of)
    first = 0
    for name, rows in _runs(context):
        part = torch.from_numpy(values[first : first + rows].copy())
        (rows_of if rows > 1 else tensors)[f"{key}/{name}"] = part
        first += rows
    return PluginState(state.values, tensors, rows_of)


def _known(kept: torch.Tensor | None, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """A copy of what was kept, or zeros."""
    if kept is None or tuple(kept.shape) != shape:
        return np.zeros(shape)
    known: NDArray[np.float64] = kept.cpu().numpy().astype(np.float64)
    return known


def _by_block(context: OperatorContext) -> bool:
    """Whether each Gramian has a block to itself: few of them, and no name twice."""
    blocks = context.blocks
    return len(blocks) <= _BLOCKS and len(set(blocks)) == len(blocks)


def _runs(context: OperatorContext) -> Iterator[tuple[str, int]]:
    """Names of blocks with the number of their Gramians: above 1 they are rows of primitives."""
    for name, run in groupby(context.blocks):
        yield name, sum(1 for _ in run)

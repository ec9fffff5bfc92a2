"""Store numbers of an operator between steps, separately for each Gramian."""

from collections.abc import Iterator
from itertools import groupby

import numpy as np
import torch
from numpy.typing import NDArray

from crossgrad_core.plugin import OperatorContext, PluginState

#: If there are more Gramians than this number, each Gramian belongs to one primitive.
_BLOCKS = 64


def recall(
    state: PluginState, context: OperatorContext, key: str, shape: tuple[int, ...]
) -> NDArray[np.float64]:
    """Return the numbers [B, *shape] that are stored under `key`.

    Return zeros at the start and after a change of shape.
    """
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
    """Return the state with `values` [B, ...] stored under `key`.

    If density control moves primitives to other rows, the stored values move with them.
    """
    tensors, rows_of = dict(state.tensors), dict(state.per_primitive)
    if _by_block(context):
        tensors[key] = torch.from_numpy(values)
        return PluginState(state.values, tensors, rows_of)
    first = 0
    for name, rows in _runs(context):
        block_values = torch.from_numpy(values[first : first + rows].copy())
        (rows_of if rows > 1 else tensors)[f"{key}/{name}"] = block_values
        first += rows
    return PluginState(state.values, tensors, rows_of)


def _known(kept: torch.Tensor | None, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return a copy of the stored values. Return zeros if no values are stored."""
    if kept is None or tuple(kept.shape) != shape:
        return np.zeros(shape)
    stored: NDArray[np.float64] = kept.cpu().numpy().astype(np.float64)
    return stored


def _by_block(context: OperatorContext) -> bool:
    """Return True if each Gramian belongs to its own block.

    If each block has its own Gramian, there are few Gramians, and all names differ.
    """
    blocks = context.blocks
    return len(blocks) <= _BLOCKS and len(set(blocks)) == len(blocks)


def _runs(context: OperatorContext) -> Iterator[tuple[str, int]]:
    """Yield the name of each block and its number of Gramians.

    A number above 1 means that each primitive has its own Gramian.
    """
    for name, run in groupby(context.blocks):
        yield name, sum(1 for _ in run)

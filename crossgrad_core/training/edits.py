"""Applying a topology edit to everything that counts primitives."""

from dataclasses import replace

import torch
from torch import Tensor

from crossgrad_core.contract.state import PluginState
from crossgrad_core.contract.topology import (
    Edit,
    Rows,
    apply_to_moment,
    apply_to_parameters,
    gather_indices,
)
from crossgrad_core.errors import UserError
from crossgrad_core.training.order import in_order
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState
from crossgrad_core.training.steady import STATE as AVERAGE
from crossgrad_core.training.steady import with_rows


def apply_edit(setup: Setup, state: TrainState, edit: Edit) -> bool:
    """Edits parameters, moments and plugin states together.

    Returns:
        Whether the set of primitives changed.

    Raises:
        UserError: The edit does not fit the parameters.
    """
    if edit.is_empty:
        return False
    if misfit := _misfit(setup, state, edit):
        raise UserError(
            "a plugin's edit does not fit the primitives",
            where=f"step {state.step}, densifier {setup.selection.names['densifier']} or a plugin "
            "that acts after steps",
            found=misfit,
            todo="repair the plugin; `crossgrad plugins check` looks at its edits",
        )
    _apply(setup, state, edit)
    if edit.source is None:
        return False
    phase = setup.phase(state.step, training=True)
    state.tensors = setup.backbone.prepare(state.tensors, setup.scene, phase)
    return True


def keep(setup: Setup, state: TrainState, rows: Tensor) -> None:
    """Keeps these primitives only, as they are: what a backbone derives is not renewed.

    What ends it halfway leaves the state as it was.

    Args:
        setup: The run.
        state: Its state.
        rows: [M] int64, in rising order.
    """
    edit, adam, before = Edit(rows), state.adam, state.primitives(setup)
    names = [n for block in setup.blocks if block.per_primitive for n in block.tensors]
    first, second = (
        {**moments, **{n: apply_to_moment(edit, n, moments[n]) for n in names if n in moments}}
        for moments in (adam.exp_avg, adam.exp_avg_sq)
    )
    tensors = apply_to_parameters(edit, setup.blocks, state.tensors)
    source, fresh = gather_indices(edit, before, rows.device)
    states = {
        name: with_rows(setup, state, old, rows)
        if name == AVERAGE
        else _gathered(name, old, source, fresh, before)
        for name, old in state.states.items()
    }
    state.moments = replace(adam, exp_avg=first, exp_avg_sq=second)
    state.tensors, state.states = tensors, states


def put_in_order(setup: Setup, state: TrainState) -> None:
    """Puts the primitives in the order in which they are kept, when a step has edited them."""
    rows = in_order(state.tensors, setup.blocks, setup.backbone.positions)
    if rows is not None:
        _apply(setup, state, Edit(source=rows))


def _misfit(setup: Setup, state: TrainState, edit: Edit) -> str:
    """What of an edit does not fit, in words; empty where all does."""
    before = state.primitives(setup)
    if wrong := _no_set(edit, before):
        return wrong
    after = before if edit.source is None else len(edit.source)
    rows = {name for block in setup.blocks if block.per_primitive for name in block.tensors}
    for name, new in edit.values.items():
        if name not in rows:
            return f"there is no tensor {name!r} with a row for each primitive"
        if wrong := _no_values(new, after, state.tensors[name].shape[1:]):
            return f"values of {name}: {wrong}"
    return ""


def _no_set(edit: Edit, before: int) -> str:
    """Why an edit of so many primitives gives no new set of them; empty where it does."""
    source, fresh = edit.source, edit.fresh
    if source is not None and (wrong := _no_list(source, torch.int64)):
        return f"source is {wrong}"
    after = before if source is None else len(source)
    if source is not None and after and not 0 <= int(source.min()) <= int(source.max()) < before:
        return f"source leaves 0 to {before - 1}"
    if fresh is not None and (wrong := _no_list(fresh, torch.bool)):
        return f"fresh is {wrong}"
    if fresh is not None and len(fresh) != after:
        return f"fresh has {len(fresh)} rows of {after}"
    return ""


def _no_list(found: object, dtype: torch.dtype) -> str:
    """What something is that should be a one-dimensional tensor of a type; empty where it is."""
    if not isinstance(found, Tensor):
        return f"of type {type(found).__module__}.{type(found).__name__}, not a tensor"
    good = found.ndim == 1 and found.dtype == dtype
    return "" if good else f"{list(found.shape)} of {found.dtype}, not [M] of {dtype}"


def _no_values(new: object, count: int, width: torch.Size) -> str:
    """Why something does not replace rows, of so many, of a width; empty where it does."""
    if not isinstance(new, Rows) or not isinstance(new.values, Tensor):
        return f"{type(new).__name__}, not Rows of a tensor"
    if new.rows is not None:
        if wrong := _no_list(new.rows, torch.int64):
            return f"rows are {wrong}"
        # On a GPU a look would be waited for.
        if new.rows.is_cpu and ((new.rows < 0) | (new.rows >= count)).any():
            return f"rows leave 0 to {count - 1}"
        count = len(new.rows)
    shape = (count, *width)
    return "" if _fits(new.values, shape) else f"{list(new.values.shape)}, not {list(shape)}"


def _fits(values: Tensor, shape: tuple[int, ...]) -> bool:
    """Whether values can be written to a tensor of a shape."""
    pairs = zip(reversed(values.shape), reversed(shape), strict=False)
    return values.ndim <= len(shape) and all(own in (1, size) for own, size in pairs)


def _apply(setup: Setup, state: TrainState, edit: Edit) -> None:
    before = state.primitives(setup)
    state.settle(edit.values if edit.source is None else None)
    for block in setup.blocks:
        if block.per_primitive:
            for name in block.tensors:
                for moments in (state.moments.exp_avg, state.moments.exp_avg_sq):
                    if name in moments:
                        moments[name] = apply_to_moment(edit, name, moments[name])
    state.tensors = apply_to_parameters(edit, setup.blocks, state.tensors)
    if edit.source is None:
        return
    source, fresh = gather_indices(edit, before, edit.source.device)
    state.states = {
        name: _gathered(name, old, source, fresh, before) for name, old in state.states.items()
    }


def _gathered(name: str, old: PluginState, source: Tensor, fresh: Tensor, rows: int) -> PluginState:
    for key, tensor in old.per_primitive.items():
        if tensor.shape[0] != rows:
            raise RuntimeError(
                f"per-primitive state {key!r} of {name} has {tensor.shape[0]} rows "
                f"for {rows} primitives"
            )
    return old.gathered(source, fresh)

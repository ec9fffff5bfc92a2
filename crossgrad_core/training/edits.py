"""Applying a topology edit to everything that counts primitives."""

from dataclasses import replace

from torch import Tensor

from crossgrad_core.contract.state import PluginState
from crossgrad_core.contract.topology import (
    Edit,
    apply_to_moment,
    apply_to_parameters,
    gather_indices,
    misfit_of,
)
from crossgrad_core.errors import UserError
from crossgrad_core.training.averaging import STATE as AVERAGE
from crossgrad_core.training.averaging import with_rows
from crossgrad_core.training.morton_order import in_order
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState


def apply_edit(setup: Setup, state: TrainState, edit: Edit) -> bool:
    """Edits parameters, moments and plugin states together.

    Returns:
        Whether the set of primitives changed.

    Raises:
        UserError: The edit does not fit the parameters.
    """
    if edit.is_empty:
        return False
    if misfit := misfit_of(edit, setup.blocks, state.tensors):
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


def _apply(setup: Setup, state: TrainState, edit: Edit) -> None:
    before = state.primitives(setup)
    state.settle(edit.values if edit.keeps_rows else None)
    for block in setup.blocks:
        if block.per_primitive:
            for name in block.tensors:
                for moments in (state.moments.exp_avg, state.moments.exp_avg_sq):
                    if name in moments:
                        moments[name] = apply_to_moment(edit, name, moments[name])
    state.tensors = apply_to_parameters(edit, setup.blocks, state.tensors)
    if edit.keeps_rows:
        return
    source, fresh = gather_indices(edit, before, setup.device)
    state.states = {
        name: _gathered(name, old, source, fresh, before) for name, old in state.states.items()
    }


def _gathered(name: str, old: PluginState, source: Tensor, fresh: Tensor, rows: int) -> PluginState:
    for key, tensor in old.per_primitive.items():
        if tensor.shape[:1] != (rows,):
            raise UserError(
                f"the state of plugin {name} does not fit the primitives",
                where=f"per_primitive, {key}",
                expected=f"a row for each of {rows} primitives, as they were before the edit",
                found=f"shape {list(tensor.shape)}",
                todo="repair the plugin (docs/hooks.md)",
            )
    return old.gathered(source, fresh)

"""Limits for density control: the primitive budget, the budget schedule, and the memory."""

import sys
from typing import cast

from crossgrad_core.config import AUTO
from crossgrad_core.contract.blocks import PluginState
from crossgrad_core.contract.schedule import Schedule
from crossgrad_core.training.memory import Demand, kept_bytes, room_for_primitives
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState
from crossgrad_core.training.views import Rendered

#: Key in `state.states` for the number of primitives at the start of a budgeted run.
STATE = "budget"


def max_new_gaussians(setup: Setup, state: TrainState, rendered: Rendered) -> int:
    """Return how many primitives the edit after this step may add; 0 if no edit is due."""
    if not setup.schedule.densifies(state.step):
        return 0
    most, present = _most(setup, state), state.primitives(setup)
    memory = room_for_primitives(setup.device, _demand(setup, state, rendered))
    return min(max(0, most - present), sys.maxsize if memory is None else memory)


def _most(setup: Setup, state: TrainState) -> int:
    """Return the largest allowed number of primitives after the edit at this step."""
    numbers = setup.numbers
    decided = numbers.max_gaussians == AUTO or "max_gaussians" in setup.config.decided
    if numbers.growth == "unbounded" and not (decided and numbers.max_gaussians):
        return cast("int", numbers.max_gaussians) or sys.maxsize
    start = started_with(setup, state)
    state.states.setdefault(STATE, PluginState({"start": start}))
    return most_after(setup, setup.schedule, state.step, start)


def started_with(setup: Setup, state: TrainState) -> int:
    """Return the number of primitives at the start of the run."""
    kept = state.states.get(STATE)
    # Before the first edit, the present number of primitives equals the initial number.
    return state.primitives(setup) if kept is None else cast("int", kept.values["start"])


def most_after(setup: Setup, schedule: Schedule, step: int, start: int) -> int:
    """Return the largest allowed number of primitives after an edit at `step`.

    Args:
        setup: The run.
        schedule: The schedule of the run.
        step: The step of the edit.
        start: Number of primitives at the start of the run.
    """
    numbers = setup.numbers
    bound = numbers.max_gaussians
    if bound == AUTO:
        bound = setup.following(schedule.total, start)["max_gaussians"]
    budget = cast("int", bound) or sys.maxsize
    if numbers.growth == "unbounded" or budget == sys.maxsize:
        return budget
    events = schedule.edits_before + schedule.edits()
    return min(budget, curve(events - schedule.edits(step), events, start, budget))


def curve(event: int, events: int, start: int, budget: int) -> int:
    """Return the allowed number of primitives after edit `event`.

    After the last edit, the result is `budget`.

    Source: Taming 3DGS (arXiv 2406.15643), A(x) = (B - S - 2 N) (x / N)^2 + 2 x + S. Here x is
    `event`, N is `events`, S is `start` and B is `budget`.
    """
    return (budget - start - 2 * events) * event * event // (events * events) + 2 * event + start


def _demand(setup: Setup, state: TrainState, rendered: Rendered) -> Demand:
    """Return the memory that a step needs for each primitive."""
    per_primitive = sum(
        state.tensors[name][:1].numel() * state.tensors[name].element_size()
        for block in setup.blocks
        if block.per_primitive
        for name in block.tensors
    )
    kept = kept_bytes(rendered.records, state.tensors.values())
    return Demand(
        parameters=per_primitive,
        kept=kept // max(1, state.primitives(setup)),
        views=len(rendered.records),
        separate=setup.separate,
        watched=bool(setup.watchers),
        joint=setup.joint or setup.rasterizer.batched,
        copies=sum(rule.copies for rule in setup.selection.rules.values()),
    )

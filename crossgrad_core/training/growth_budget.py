"""How many primitives density control may add: a budget, a curve that leads to it, the memory."""

import sys
from typing import cast

from crossgrad_core.config import AUTO
from crossgrad_core.contract.blocks import PluginState
from crossgrad_core.contract.schedule import Schedule
from crossgrad_core.training.memory import Demand, kept_bytes, room_for_primitives
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState
from crossgrad_core.training.views import Rendered

#: Under this name a run with a curve, or with a budget by itself, keeps the number at its start.
STATE = "budget"


def max_new_gaussians(setup: Setup, state: TrainState, rendered: Rendered) -> int:
    """How many primitives this step's edit may add; 0 where none is due."""
    if not setup.schedule.densifies(state.step):
        return 0
    most, present = _most(setup, state), state.primitives(setup)
    memory = room_for_primitives(setup.device, _demand(setup, state, rendered))
    return min(max(0, most - present), sys.maxsize if memory is None else memory)


def _most(setup: Setup, state: TrainState) -> int:
    """The most primitives that there may be after this step's edit."""
    numbers = setup.numbers
    decided = numbers.max_gaussians == AUTO or "max_gaussians" in setup.config.decided
    if numbers.growth == "unbounded" and not (decided and numbers.max_gaussians):
        return cast("int", numbers.max_gaussians) or sys.maxsize
    start = started_with(setup, state)
    state.states.setdefault(STATE, PluginState({"start": start}))
    return most_after(setup, setup.schedule, state.step, start)


def started_with(setup: Setup, state: TrainState) -> int:
    """The number of primitives at the start of a run, where growth depends on it."""
    kept = state.states.get(STATE)
    # Nothing is added before the first edit: what is there until then is the start.
    return state.primitives(setup) if kept is None else cast("int", kept.values["start"])


def most_after(setup: Setup, schedule: Schedule, step: int, start: int) -> int:
    """The most primitives that there may be after an edit in a run that began with `start`.

    Args:
        setup: The run.
        schedule: Its schedule.
        step: The step of the edit.
        start: Primitives at the start.
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
    """How many primitives there may be after an edit; `budget` after the last one.

    Source: Taming 3DGS (arXiv 2406.15643), A(x) = (B - S - 2 N) (x / N)^2 + 2 x + S.
    """
    return (budget - start - 2 * events) * event * event // (events * events) + 2 * event + start


def _demand(setup: Setup, state: TrainState, rendered: Rendered) -> Demand:
    """What a step keeps for each primitive."""
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

"""How many primitives density control may add: a budget, a curve that leads to it, the memory."""

import sys
from math import exp, log
from typing import Literal, cast

from crossgrad_core.config import AUTO
from crossgrad_core.contract.schedule import REFERENCE, Schedule, shortness
from crossgrad_core.contract.state import PluginState
from crossgrad_core.training.averaging import average_of
from crossgrad_core.training.memory import Demand, kept_bytes, room_for_primitives
from crossgrad_core.training.rates import in_a_hurry
from crossgrad_core.training.schedules import growth_of
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState
from crossgrad_core.training.views import Rendered

#: Under this name a run with a curve, or with a budget by itself, keeps the number at its start.
STATE = "budget"
#: The budget of runs of so many views, and the power of the length with which that of longer ones
#: grows at first: to 100,000 at 10,000 views. Source: measured by metal-gauss.
SHORT_BUDGET, SHORT_LENGTH, POWER = 30_000, 1_000, log(100 / 30) / log(10)
#: Where a run begins with few primitives, so many times as many are enough, though not fewer than
#: that: a short run has no time to place more. Measured by us (docs/schedules.md).
GROWN, LEAST_BUDGET = 2, 10_000
#: Pixels of the photos with which that was measured (400 x 300), and the power of larger ones with
#: which more pay in short runs: they show more. Measured by us (docs/schedules.md).
PIXELS, FINER = 120_000, 0.4
#: The further power in runs in a hurry, which cannot learn photos by heart, and the largest photos
#: (800 x 600) with which that was measured.
HURRIED_FINER, HURRIED_PIXELS = 0.5, 480_000


def max_new_gaussians(setup: Setup, state: TrainState, rendered: Rendered) -> int:
    """How many primitives this step's edit may add; 0 where none is due."""
    if not setup.schedule.densifies(state.step):
        return 0
    most, present = _most(setup, state), state.primitives(setup)
    memory = room_for_primitives(setup.device, _demand(setup, state, rendered))
    return min(max(0, most - present), sys.maxsize if memory is None else memory)


def _most(setup: Setup, state: TrainState) -> int:
    """The most primitives that there may be after this step's edit."""
    given = bound_of(setup)
    if growth_of(setup) == "free" and given != AUTO:
        return given or sys.maxsize
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
        setup: The run; its growth follows the curve, or its budget is `auto`.
        schedule: Its schedule.
        step: The step of the edit.
        start: Primitives at the start.
    """
    given = bound_of(setup)
    if given == AUTO:
        hurried = in_a_hurry(setup.config, schedule, len(setup.train_views))
        pixels = setup.scene.train_pixels
        budget = usual_budget(start, schedule.length, pixels, hurried=hurried)
    else:
        budget = given or sys.maxsize
    if growth_of(setup) == "free" or budget == sys.maxsize:
        return budget
    events = schedule.edits_before + schedule.edits()
    return min(budget, curve(events - schedule.edits(step), events, start, budget))


def bound_of(setup: Setup) -> int | Literal["auto"] | None:
    """The bound on the number of primitives; a curve to nowhere leads to what suits the length."""
    given = setup.config.max_gaussians
    return AUTO if given is None and growth_of(setup) == "curve" else given


def usual_budget(start: int, length: int, pixels: float = PIXELS, *, hurried: bool = False) -> int:
    """The budget of a run that began with `start` primitives and has `length` views.

    It has no bound any more at the published length, whose rules know none.

    Args:
        start: Primitives at the start.
        length: Views.
        pixels: Of a training photo, mean.
        hurried: Whether the run is in a hurry.
    """
    if length >= REFERENCE:
        return sys.maxsize
    stretch = exp(POWER * log(max(1.0, length / SHORT_LENGTH)))
    enough = min(SHORT_BUDGET, max(LEAST_BUDGET, GROWN * start))
    if enough == SHORT_BUDGET:
        finer = FINER * log(max(1.0, pixels / PIXELS))
        if hurried:
            finer += HURRIED_FINER * log(max(1.0, min(pixels, HURRIED_PIXELS) / PIXELS))
        stretch *= exp(shortness(length) * finer)
    return round(max(enough, start) * stretch / (1.0 - length / REFERENCE))


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
        averaged=average_of(setup.config) > 0.0,
    )

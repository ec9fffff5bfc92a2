"""The learning rates of a step and how Adam averages in it."""

from math import sqrt
from typing import Final

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.blocks import LearningRate
from crossgrad_core.contract.schedule import REFERENCE, Schedule
from crossgrad_core.training.adam.coefficients import Rule
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.steady import faded

#: The published rates are for `REFERENCE` steps. A run of fewer has them times the ratio of the two
#: to this power: what its rates add up to falls with its length, but not as fast as the length.
SHORTNESS: Final = 0.45
#: ... and never more than this: what a run of some 1,000 steps has.
MOST: Final = 4.5

#: Blocks that learn in one of n steps have n to this power times their rate then.
RESTED: Final = 0.5


def factor_of(config: RunConfig, schedule: Schedule) -> float:
    """What all rates of the backbone are multiplied by, given how long the run is to be."""
    if config.rate_factor is not None or config.preset == "inria":
        return config.rate_factor or 1.0
    steps = schedule.total if schedule.mode == "scaled" else schedule.step_of(schedule.length)
    return min(max(1.0, float((REFERENCE / steps) ** SHORTNESS)), MOST)


def notes_on(config: RunConfig, schedule: Schedule) -> tuple[str, ...]:
    """That the rates are larger than the published ones, where the run asked for none."""
    factor = factor_of(config, schedule)
    # The length of a run within a budget is not known yet.
    known = config.seconds is None or schedule.mode == "absolute"
    if config.rate_factor is not None or config.preset == "inria" or (known and factor == 1.0):
        return ()
    told = f"{factor:.3g}" if known else f"({REFERENCE:,} / steps)^{SHORTNESS}, at most {MOST}"
    return (f"learning rates: those for {REFERENCE:,} steps (--rate-factor 1) times {told}",)


def rates_at(setup: Setup, step: int) -> dict[str, float]:
    """Name of each trained tensor -> its learning rate in a step."""
    every = setup.schedule.sh_every
    return {
        name: rate_at(setup, block.lr, step) * (every**RESTED if block.rests else 1.0)
        for block in setup.trained_blocks
        for name in block.tensors
    }


def means_rate_at(setup: Setup, step: int) -> float:
    """The learning rate of the primitives' positions in a step; 0 where they do not move."""
    rates = {block.name: block.lr for block in setup.blocks}
    return rate_at(setup, rates.get("means", LearningRate(0.0)), step)


def rate_at(setup: Setup, rate: LearningRate, step: int) -> float:
    """A learning rate of the backbone in a step: of the schedule, times what the run asks for."""
    config, schedule = setup.config, setup.schedule
    factor = factor_of(config, schedule) * faded(config, rate, step=step, total=schedule.total)
    if config.batch_rule == "sqrt":
        factor *= sqrt(schedule.pace.at(step))
    return rate.at(schedule.progress(step)) * factor


def rule_at(setup: Setup, step: int) -> Rule:
    """How Adam averages in a step."""
    if setup.config.batch_rule == "none":
        return Rule()
    pace = setup.schedule.pace
    views = pace.at(step)
    return Rule.for_views(views, pace.views(step) / (step * views))

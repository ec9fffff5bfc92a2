"""The learning rates of a step and how Adam averages in it."""

from math import sqrt

from crossgrad_core.contract.blocks import LearningRate
from crossgrad_core.training.adam.coefficients import Rule
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.steady import faded


def rates_at(setup: Setup, step: int) -> dict[str, float]:
    """Name of each trained tensor -> its learning rate in a step."""
    return {
        name: rate_at(setup, block.lr, step)
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
    factor = config.rate_factor * faded(config, rate, step=step, total=schedule.total)
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

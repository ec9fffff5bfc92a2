"""The learning rates and the moment decay rates of Adam in a step."""

from math import sqrt
from typing import Final

from crossgrad_core.contract.blocks import AdamRule, LearningRate, Parameters
from crossgrad_core.errors import UserError
from crossgrad_core.training.rules import rate_factor
from crossgrad_core.training.setup import Setup
from crossgrad_core.wording import listed

#: Numbers of columns of the tensors of positions, log scales and rotations.
_AXES: Final = (3, 3, 4)

#: If a tensor is updated in one of n steps, its learning rate is multiplied by n to this power.
RESTED: Final = 0.5


def axes_of(setup: Setup) -> tuple[str, str, str] | None:
    """Return the names of the tensors of positions, scales and rotations.

    Return None if `position_lr` is not `per-axis`.
    """
    return setup.backbone.gaussian_tensors if setup.numbers.position_lr == "per-axis" else None


def check_axes(setup: Setup, parameters: Parameters) -> None:
    """Check that the tensors in `Backbone.gaussian_tensors` have the shapes of Gaussians.

    Raises:
        UserError: A tensor has a wrong shape. The message names the backbone.
    """
    if (names := setup.backbone.gaussian_tensors) is None:
        return
    rows = len(parameters[names[0]]) if names[0] in parameters else 0
    shapes = [tuple(parameters[name].shape) if name in parameters else None for name in names]
    if shapes != [(rows, columns) for columns in _AXES]:
        raise UserError(
            "the axes that the backbone names do not have the shapes of Gaussians",
            where=f"backbone {setup.selection.names['backbone']}, axes {listed(names)}",
            expected=f"tensors {listed(f'[N, {columns}]' for columns in _AXES)}",
            found=listed(map(str, shapes)),
            todo="repair the plugin (docs/write-a-backbone.md)",
        )


def rates_at(setup: Setup, step: int) -> dict[str, float]:
    """Return the learning rate of each trained tensor in a step, by tensor name."""
    intervals = setup.update_intervals
    return {
        name: rate_at(setup, block.lr, step) * float(intervals.get(name, 1) ** RESTED)
        for block in setup.trained_blocks
        for name in block.tensors
    }


def means_rate_at(setup: Setup, step: int) -> float:
    """Return the learning rate of the positions in a step.

    The rate is 0 if the backbone does not train positions.
    """
    rates = {block.name: block.lr for block in setup.blocks}
    return rate_at(setup, rates.get("means", LearningRate(0.0)), step)


def rate_at(setup: Setup, rate: LearningRate, step: int) -> float:
    """Return a learning rate in a step: its scheduled value, multiplied by all factors."""
    numbers, schedule = setup.numbers, setup.schedule
    factor = numbers.rate_factor * (rate.few_passes if numbers.few_pass_rates else 1.0)
    factor *= rate_factor(setup, rate, step)
    if setup.config.batch_rule == "sqrt":
        factor *= sqrt(schedule.pace.at(step))
    return rate.at(schedule.progress(step)) * factor


def rule_at(setup: Setup, step: int) -> AdamRule:
    """Return the Adam rule of a step: decay rates, eps and bias correction."""
    betas = setup.numbers.beta1, setup.numbers.beta2
    if setup.config.batch_rule == "none":
        return AdamRule(betas)
    pace = setup.schedule.pace
    views = pace.at(step)
    return AdamRule.for_views(views, pace.views(step) / (step * views), betas)

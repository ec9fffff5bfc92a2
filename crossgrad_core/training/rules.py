"""Calls of the hooks of rules: Gaussians, learning rates, and parameters for evaluation."""

from dataclasses import replace
from math import inf, prod
from numbers import Real

from torch import Tensor

from crossgrad_core.contract.blocks import LearningRate, Parameters
from crossgrad_core.contract.gaussians import Gaussians
from crossgrad_core.contract.slots.rule import GaussiansContext, GaussiansResult
from crossgrad_core.registry.manager import call_all, wrong_answer
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState


def view_gaussians(setup: Setup, state: TrainState, context: GaussiansContext) -> Gaussians:
    """Return the Gaussians from which a training view is rendered, after changes by rules.

    Raises:
        UserError: A rule returns a different number of Gaussians.
    """
    count = len(context.gaussians)
    for hook in setup.gaussians_hooks:
        for answer in call_all(hook, context, GaussiansResult):
            if len(answer.gaussians) != count:
                raise wrong_answer(hook, f"{count} Gaussians", f"{len(answer.gaussians)} Gaussians")
            state.accept(answer.states, hook)
            context = replace(context, gaussians=answer.gaussians)
    return context.gaussians


def rate_factor(setup: Setup, rate: LearningRate, step: int) -> float:
    """Return the product of all factors by which rules change a learning rate in a step.

    Raises:
        UserError: A rule returns a factor that is negative or not a finite number.
    """
    if not setup.changes_rates:
        return 1.0
    hook = setup.hook.crossgrad_rate_factor
    factors: list[float] = hook(rate=rate, step=step, schedule=setup.schedule)
    for factor in factors:
        if not (isinstance(factor, Real) and 0.0 <= factor < inf):
            raise wrong_answer(hook, "a finite number of 0 or more, or None", repr(factor))
    return float(prod(map(float, factors)))


def eval_parameters(setup: Setup, state: TrainState) -> Parameters:
    """Return the parameters for evaluations and exports, after changes by rules.

    Raises:
        UserError: A rule returns a tensor whose name or shape does not match the parameters.
    """
    hook, shown = setup.hook.crossgrad_eval_parameters, dict(state.parameters)
    answers: list[dict[str, Tensor]] = hook(states=state.states, step=state.step)
    for name, tensor in (item for answer in answers for item in answer.items()):
        if name not in shown or tensor.shape != shown[name].shape:
            raise wrong_answer(
                hook, "tensors with the names and shapes of parameters", f"{name}: {tensor.shape}"
            )
        shown[name] = tensor
    return shown

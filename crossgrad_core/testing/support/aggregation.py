"""Contract checks for operators in a training step, where they combine K gradients."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import count
from math import nan

import numpy as np
import torch
from torch import Tensor

from crossgrad_core.contract.blocks import Block, LearningRate, PluginState
from crossgrad_core.contract.contexts import AggregateContext, AggregateResult
from crossgrad_core.contract.slots.operator import STATE, Operator
from crossgrad_core.gradients.separate import DenseGradients
from crossgrad_core.gradients.summed import SummedGradients
from crossgrad_core.testing.fixtures import step_fields
from crossgrad_core.testing.support.contract import (
    Check,
    Make,
    admitted,
    global_randomness_untouched,
    require,
    revived,
    same_state,
)
from crossgrad_core.testing.support.growth import require_bounded, size_of
from crossgrad_core.training.setup import OperatorScale

_RATE = LearningRate(0.01)
BLOCKS = (
    Block("means", ("means",), True, "geometry", _RATE),
    Block("f_dc", ("f_dc",), True, "appearance", _RATE),
    Block("net", ("net.weight", "net.bias"), False, "neutral", _RATE),
)
_SHAPES = {"means": (5, 3), "f_dc": (5, 1, 3), "net.weight": (4, 2), "net.bias": (4,)}

Gradients = dict[str, Tensor | None]


def sample_gradients(views: int, seed: int = 0) -> list[Gradients]:
    """Create random gradients of `views` views.

    With two or more views, the last view has no gradient of one block.
    """
    rng = np.random.default_rng([views, seed])

    def gradient(shape: tuple[int, ...]) -> Tensor:
        return torch.from_numpy(rng.normal(size=shape).astype(np.float32))

    gradients: list[Gradients] = [
        {name: gradient(shape) for name, shape in _SHAPES.items()} for _ in range(views)
    ]
    # With more than one view, the last view has no gradient of the network.
    if views > 1:
        gradients[-1] |= {"net.weight": None, "net.bias": None}
    return gradients


def aggregate_context(
    gradients: Sequence[Mapping[str, Tensor | None]], *, summed: bool = False
) -> AggregateContext:
    """Create the context of the aggregation hook for some gradients.

    Args:
        gradients: The gradients of each view.
        summed: True to provide only the sum of the gradients, as in a run in which no plugin reads
            separate gradients.
    """
    views = len(gradients)
    rng = np.random.default_rng(views)
    return AggregateContext(
        **step_fields(),
        gradients=_summed(gradients) if summed else DenseGradients(gradients, BLOCKS),
        losses=rng.uniform(0.05, 0.3, views),
        labels=tuple(("near", "far")[view % 2] for view in range(views)),
        distances=rng.uniform(0.2, 1.0, views),
        reference_distance=0.5,
        blocks=BLOCKS,
    )


def _summed(gradients: Sequence[Mapping[str, Tensor | None]]) -> SummedGradients:
    total = SummedGradients.empty(BLOCKS, len(gradients))
    for view in gradients:
        # The sum owns and modifies the tensors that are added.
        total.add(
            {
                name: None if gradient is None else gradient.clone()
                for name, gradient in view.items()
            }
        )
    return total


def aggregated(
    operator: Operator, gradients: Sequence[Mapping[str, Tensor | None]], *, summed: bool = False
) -> AggregateResult:
    """Return the operator's result of the aggregation hook (see `aggregate_context`)."""
    return _answer(operator, aggregate_context(gradients, summed=summed))


def _answer(operator: Operator, context: AggregateContext) -> AggregateResult:
    answer: object = operator.crossgrad_aggregate_gradients(context)
    if not isinstance(answer, AggregateResult):
        require(False, f"the operator returns {answer!r} in the hook, not an AggregateResult")
        raise TypeError
    return answer


def every_tensor_is_answered(make: Make[Operator]) -> None:
    """The result contains a finite gradient of the right shape for every tensor.

    An operator without `separate = True` returns equal gradients if only the sum is available.
    """
    operator = make()
    for views in admitted(operator.views):
        answer = aggregated(operator, sample_gradients(views))
        names = set(answer.gradients)
        require(names == set(_SHAPES), f"K = {views}: gradients of {sorted(names)} were returned")
        for name, shape in _SHAPES.items():
            _require_gradient(f"K = {views}: the gradient of {name}", answer.gradients[name], shape)
        good = all(type(count) is int and count >= 0 for count in answer.counts.values())
        require(good, f"the counts {answer.counts} are not plain numbers")
        if not operator.separate:
            alone = aggregated(operator, sample_gradients(views), summed=True).gradients
            for name, gradient in answer.gradients.items():
                what = f"K = {views}: the gradient of {name}, of the sum and of single views,"
                _require_same(what, alone.get(name), gradient)


def _require_gradient(what: str, gradient: Tensor | None, shape: tuple[int, ...]) -> None:
    require(gradient is not None, f"{what} is missing")
    if gradient is not None:
        require(tuple(gradient.shape) == shape, f"{what} has the shape {list(gradient.shape)}")
        require(gradient.dtype == torch.float32, f"{what} is {gradient.dtype}")
        require(gradient.isfinite().all(), f"{what} is not finite")


def absent_views_have_no_weight(make: Make[Operator]) -> None:
    """A view without a valid gradient has no influence.

    A gradient is invalid if the gradient is missing, zero or not finite.
    """
    operator = make()
    for views in admitted(operator.views):
        answers = []
        for gradient in (None, torch.zeros(_SHAPES["means"]), torch.full(_SHAPES["means"], nan)):
            gradients = sample_gradients(views)
            gradients[0]["means"] = gradient
            answers.append(aggregated(operator, gradients).gradients["means"])
        unseen, zero, broken = answers
        what = f"K = {views}: the gradient of means"
        if views > 1:
            _require_gradient(f"{what}, one view not finite,", broken, _SHAPES["means"])
            _require_same(f"{what} if one view is zero, or does not see it,", zero, unseen)
            _require_same(f"{what} if one view is zero, or not finite,", zero, broken)
        else:
            require(broken is None, f"{what} is not None, although no view has a finite gradient")


def _require_same(what: str, one: Tensor | None, other: Tensor | None) -> None:
    same = one is not None and other is not None and torch.equal(one, other)
    require(same, f"{what} differs")


def gradients_stay_untouched(make: Make[Operator]) -> None:
    """The operator does not change the gradients of the views.

    Other plugins read the gradients of the views later.
    """
    operator = make()
    for views in admitted(operator.views):
        gradients, copies = sample_gradients(views), sample_gradients(views)
        aggregated(operator, gradients)
        for mine, copy in zip(gradients, copies, strict=True):
            for name, gradient in mine.items():
                kept = copy[name]
                same = gradient is None or (kept is not None and torch.equal(gradient, kept))
                require(same, f"K = {views}: aggregating changes the views' gradients of {name}")


def same_seed_same_aggregation(make: Make[Operator]) -> None:
    """Two calls with equal seeds return equal bits.

    The returned states survive a checkpoint.
    """
    for views in admitted(make().views):
        with global_randomness_untouched():
            one = aggregated(make(), sample_gradients(views))
            other = aggregated(make(), sample_gradients(views))
        for name, gradient in one.gradients.items():
            again = other.gradients[name]
            same = gradient is not None and again is not None and torch.equal(gradient, again)
            require(same, f"K = {views}: two calls with the same seed differ in {name}")
        for name, state in one.states.items():
            require(
                same_state(revived(state), other.states[name]), f"K = {views}: the states differ"
            )


def equal_gradients_have_a_scale(make: Make[Operator]) -> None:
    """K equal gradients in a neutral context get finite weights, which are equal in every call.

    The sum of these weights determines the scale of regularization terms and of the optimizer's
    input.
    """
    for views in admitted(make().views):
        context = aggregate_context(sample_gradients(views))
        one, other = (OperatorScale(make()).of(context).per_step for _ in range(2))
        require(
            one == other, f"K = {views}: equal gradients receive different weights in two calls"
        )


def states_stay_bounded(make: Make[Operator]) -> None:
    """The state does not grow with the number of steps."""
    operator = make()
    views = max(admitted(operator.views)[:2])
    states = _states(operator, aggregate_context(sample_gradients(views)))
    require_bounded(map(size_of, states), "aggregate")


def _states(operator: Operator, context: AggregateContext) -> Iterator[PluginState]:
    """Yield the operator's state after each step of a run without an end."""
    states: Mapping[str, PluginState] = {}
    for step in count(1):
        states = _answer(operator, replace(context, step=step, states=states)).states
        yield states[STATE]


AGGREGATION_CHECKS: tuple[Check[Operator], ...] = (
    every_tensor_is_answered,
    equal_gradients_have_a_scale,
    absent_views_have_no_weight,
    gradients_stay_untouched,
    same_seed_same_aggregation,
    states_stay_bounded,
)

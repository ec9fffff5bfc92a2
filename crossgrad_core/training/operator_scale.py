"""How much an operator makes of K equal gradients: the scale that all else in a step follows."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import isfinite

import numpy as np
import torch

from crossgrad_core.contract.contexts import AggregateContext
from crossgrad_core.contract.operator import Operator
from crossgrad_core.contract.state import EMPTY_STATE
from crossgrad_core.errors import UserError
from crossgrad_core.gradients.separate import DenseGradients


@dataclass(frozen=True)
class Scale:
    """The scale of an operator's answer at one K, by tensor name.

    Attributes:
        per_step: c(K), what it makes of K equal gradients: K for their sum, 1 for their mean.
        per_view: c(K) / K.
        to_sum: K / |c(K)|, what brings the answer to the scale of the views' sum. Adam sees that
            one, as its eps and the limits of its arithmetic are absolute.
    """

    per_step: Mapping[str, float]
    per_view: Mapping[str, float]
    to_sum: Mapping[str, float]

    @classmethod
    def of(cls, sums: Mapping[str, float], views: int) -> "Scale":
        """The scale of an operator with these c(K) at K = `views`."""
        shares = {name: value / views for name, value in sums.items()}
        # An operator that answers equal gradients with zero has no scale to follow.
        to_sum = {name: 1.0 / (abs(share) or 1.0) for name, share in shares.items()}
        return cls(sums, shares, to_sum)


class OperatorScale:
    """c(K), the sum of an operator's weights for K equal gradients in a neutral context.

    The operator is asked once for each K and its labels, with K equal gradients of one element per
    tensor, without memory and with nothing that tells the views apart but their labels. So every
    operator has a scale: chains, one operator per block, those that work on elements, and a third
    party's.

    Args:
        operator: The operator.
    """

    def __init__(self, operator: Operator) -> None:
        self._operator = operator
        self._known: dict[tuple[int, tuple[str, ...] | None], Scale] = {}

    def of(self, context: AggregateContext) -> Scale:
        """The scale for the K and the labels of this step.

        Raises:
            UserError: The operator's answer to equal gradients is not finite.
        """
        key = (len(context.losses), context.labels)
        if key not in self._known:
            self._known[key] = Scale.of(self._asked(neutral(context)), len(context.losses))
        return self._known[key]

    def _asked(self, context: AggregateContext) -> dict[str, float]:
        answer, _ = self._operator.aggregate(context, EMPTY_STATE)
        sums = {}
        for name in (name for block in context.blocks for name in block.tensors):
            gradient = answer.gradients.get(name)
            sums[name] = 0.0 if gradient is None else float(gradient.sum())
            if not isfinite(sums[name]):
                raise self._not_finite(name, len(context.losses))
        return sums

    def _not_finite(self, name: str, views: int) -> UserError:
        return UserError(
            f"operator {type(self._operator).__name__} gives {views} equal gradients a weight that "
            "is not finite",
            where=f"block of {name}",
            expected="finite weights for finite gradients",
            todo="use another operator, or report this to the operator's author",
        )


def neutral(context: AggregateContext) -> AggregateContext:
    """The first step of K views, all at full size and alike in gradients, losses and distances."""
    views = len(context.losses)
    names = [name for block in context.blocks for name in block.tensors]
    unit = {name: torch.ones(1, dtype=torch.float64) for name in names}
    return replace(
        context,
        step=1,
        states={},
        rng=np.random.default_rng(0),
        gradients=DenseGradients([unit] * views, context.blocks),
        losses=np.ones(views),
        distances=np.full(views, context.reference_distance),
        scales=(1.0,) * views,
    )

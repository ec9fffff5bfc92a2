"""Gradient clipping per block: a wrapper of the aggregation hook."""

from collections.abc import Generator
from dataclasses import replace
from math import sqrt
from typing import cast

from pydantic import Field

from crossgrad_core.plugin import (
    AggregateContext,
    AggregateResult,
    Observer,
    PluginState,
    hookimpl,
)

#: Name of the plugin state. The state is kept between steps and in checkpoints.
STATE = "clip"


class Clip(Observer):
    """Shortens the aggregated gradient of a block to `max_norm` if it is longer."""

    max_norm: float = Field(1.0, gt=0.0, description="maximum length of a block's gradient")

    @hookimpl(wrapper=True)
    def crossgrad_aggregate_gradients(
        self, context: AggregateContext
    ) -> Generator[None, AggregateResult, AggregateResult]:
        """Let the operator aggregate, then clip the operator's result."""
        aggregated = yield
        gradients, clipped = dict(aggregated.gradients), 0
        for block in context.blocks:
            present = {name: g for name in block.tensors if (g := gradients[name]) is not None}
            # The clipping treats the tensors of a block as one vector.
            norm = sqrt(sum(float(gradient.square().sum()) for gradient in present.values()))
            if norm > self.max_norm:
                clipped += 1
                gradients |= {name: g * (self.max_norm / norm) for name, g in present.items()}
        total = cast("int", context.state(STATE).values.get("clipped", 0)) + clipped
        counts = {**aggregated.counts, "clipped": clipped}
        answer = replace(aggregated, gradients=gradients, counts=counts)
        return answer.with_state(STATE, PluginState({"clipped": total}))

"""Soft projection: pairwise projection with a threshold and a strength, for sweeps."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from typing_extensions import override

from crossgrad_core.plugin import GramianOperator, OperatorContext, PluginState, Selection
from crossgrad_operators._pairs import project, slot_order


class Soft(GramianOperator):
    """Where cos(g_i, g_j) < -threshold, `strength` times the component along g_j is taken away.

    v -= strength (v.g_j / |g_j|^2) g_j. Threshold 0 and strength 1 are `symmetric`, strength 0 is
    `sum`; the rule jumps at a threshold above 0. Pairs in the order of the slots.
    """

    identity_at_one: ClassVar[bool] = True
    threshold: float = Field(0.0, ge=0, le=1, description="conflicts are cosines below minus this")
    strength: float = Field(1.0, ge=0, le=1, description="share of the component that is removed")

    @override
    def reads_gramians(self) -> bool:
        return self.strength > 0

    def unused_options(self, selection: Selection) -> Mapping[str, str]:
        """See `HasUnusedOptions`."""
        if self.strength > 0:
            return {}
        return {"threshold": "nothing is taken away where strength = 0; leave it out"}

    @override
    def transform(
        self,
        gramians: NDArray[np.float64],
        context: OperatorContext,
        state: PluginState,
        rng: np.random.Generator,
    ) -> tuple[NDArray[np.float64], PluginState]:
        matrices = project(
            gramians,
            context,
            slot_order(gramians.shape[1]),
            threshold=self.threshold,
            strength=self.strength,
        )
        return matrices, state

"""Symmetric projection, the primary operator of CrossGrad-GS (arXiv 2605.00052)."""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from crossgrad_core.plugin import GramianOperator, OperatorContext, PluginState
from crossgrad_operators._pairs import project, slot_order


class Symmetric(GramianOperator):
    """Where two gradients conflict, each loses its component along the other; then they are added.

    g_1' = g_1 - (m / |g_2|^2) g_2 and g_2' = g_2 - (m / |g_1|^2) g_1 for m = g_1.g_2 < 0 (paper,
    equations proj_near, proj_far and final_update): two-task PCGrad. With more than two views every
    ordered pair is treated in the order of the slots, always with the original partner.
    """

    identity_at_one: ClassVar[bool] = True

    @override
    def transform(
        self,
        gramians: NDArray[np.float64],
        context: OperatorContext,
        state: PluginState,
        rng: np.random.Generator,
    ) -> tuple[NDArray[np.float64], PluginState]:
        return project(gramians, context, slot_order(gramians.shape[1])), state

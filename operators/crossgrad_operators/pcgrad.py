"""PCGrad (Yu et al. 2020, "Gradient surgery for multi-task learning", algorithm 1)."""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from crossgrad_core.plugin import GramianOperator, OperatorContext, PluginState
from crossgrad_operators._pairs import project, random_order


class PCGrad(GramianOperator):
    """Each gradient loses its components against conflicting partners, in random order.

    For each i: v = g_i; for j != i in random order: if v.g_j < 0, v -= (v.g_j / |g_j|^2) g_j, with
    the original g_j; u is the sum of the v. One order per step serves all blocks; with two views
    there is nothing to draw.
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
        order = random_order(gramians.shape[1], rng)
        return project(gramians, context, order), state

"""GradVac (Wang et al. 2021, "Gradient vaccine")."""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from typing_extensions import override

from crossgrad_core.plugin import GramianOperator, OperatorContext, PluginState
from crossgrad_operators._memory import recall, remember
from crossgrad_operators._weights import Floats, refine
from crossgrad_operators.projection import random_order


class GradVac(GramianOperator):
    """The sum of rotated gradients.

    Each gradient is rotated towards the other gradients, up to the average cosine of the pair.

    For each view i, v starts as g_i. For all j != i in random order, phi = cos(v, g_j). If phi is
    below the target t_ij, a multiple of g_j is added to v, so that the cosine becomes t_ij. In any
    case, the target t_ij becomes (1 - beta) t_ij + beta phi, clipped to +-0.999. All targets start
    at 0, so that the first step equals PCGrad.
    """

    identity_at_one: ClassVar[bool] = True
    beta: float = Field(0.5, ge=0, le=1, description="weight of the newest cosine in the target")

    @override
    def transform(
        self,
        gramians: NDArray[np.float64],
        context: OperatorContext,
        state: PluginState,
        rng: np.random.Generator,
    ) -> tuple[NDArray[np.float64], PluginState]:
        from crossgrad_operators.numba_kernels.projection import aligned_to_targets

        views = gramians.shape[1]
        targets = recall(state, context, "target", (views, views))
        before, order = targets.copy(), random_order(views, rng)
        rule = self.beta, context.unit
        matrices, ill_conditioned = aligned_to_targets(
            gramians, np.zeros_like(gramians), context.present, order, targets, *rule, None
        )

        def exact(
            gramians: Floats, rounding_residuals: Floats, present: NDArray[np.bool_]
        ) -> Floats:
            again = before[ill_conditioned]
            rows, _ = aligned_to_targets(
                gramians, rounding_residuals, present, order, again, *rule, True
            )
            targets[ill_conditioned] = again
            return rows

        refine(matrices, ill_conditioned, gramians, context, exact)
        return matrices, remember(state, context, "target", targets)

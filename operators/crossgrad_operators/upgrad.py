"""UPGrad (Quinton and Rey 2024, "Jacobian descent for multi-objective optimization")."""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from crossgrad_core.plugin import GramianOperator, OperatorContext, PluginState


class UPGrad(GramianOperator):
    """The mean of the gradients, each projected on the cone that conflicts with no gradient.

    For each k: v_k = argmin v^T G v subject to v >= e_k / K; u = sum of the v_k G. Two views: half
    of `symmetric`. All active sets for up to four views, Lawson and Hanson's method above.
    """

    idle_at_one: ClassVar[bool] = True

    @override
    def transform(
        self,
        gramians: NDArray[np.float64],
        context: OperatorContext,
        state: PluginState,
        rng: np.random.Generator,
    ) -> tuple[NDArray[np.float64], PluginState]:
        from crossgrad_operators.numba_kernels.cone import upgrad

        return upgrad(gramians, context.present), state

"""UPGrad (Quinton and Rey 2024, "Jacobian descent for multi-objective optimization")."""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from crossgrad_core.plugin import GramianOperator, OperatorContext, PluginState
from crossgrad_operators._weights import extended_precision


class UPGrad(GramianOperator):
    """The mean of the gradients, each projected on the cone that conflicts with no gradient.

    For each k: v_k = argmin v^T G v subject to v >= e_k / K; u = sum of the v_k G. Two views: half
    of `symmetric`. Closed form for two views, Lawson and Hanson's active sets above, with 32 digits
    for gradients in float64.
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
        from crossgrad_operators.numba_kernels.cone import upgrad

        return extended_precision(upgrad, gramians, context), state

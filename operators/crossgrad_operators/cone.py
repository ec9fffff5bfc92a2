"""Project onto the cone of directions that conflict with no gradient: UPGrad and DualProj."""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from crossgrad_core.plugin import GramianOperator, OperatorContext, PluginState, Weighting
from crossgrad_operators._weights import extended_precision


class UPGrad(GramianOperator):
    """Project each gradient onto the cone of conflict-free directions, and average the results.

    For each view k, v_k = argmin v^T G v subject to v >= e_k / K. The result u is the sum of all
    combinations v_k of the gradients. For two views, u is half of the result of `symmetric`. For
    two views, a closed form is used. For more views, the active-set method of Lawson and Hanson is
    used. For float64 gradients, weights are computed with 32 digits.

    Source: Quinton and Rey 2024, "Jacobian descent for multi-objective optimization".
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


class DualProj(Weighting):
    """Project the mean gradient onto the cone of conflict-free directions.

    The weights are v = argmin v^T G v subject to v >= 1/K, with the Gramian G. For two views, a
    closed form is used. For more views, the active-set method of Lawson and Hanson is used. For
    float64 gradients, weights are computed with 32 digits.

    Source: Lopez-Paz and Ranzato 2017; TorchJD uses the name DualProj.
    """

    identity_at_one: ClassVar[bool] = True

    @override
    def weights(
        self, gramians: NDArray[np.float64], context: OperatorContext
    ) -> NDArray[np.float64]:
        from crossgrad_operators.numba_kernels.cone import dualproj

        return extended_precision(dualproj, gramians, context)

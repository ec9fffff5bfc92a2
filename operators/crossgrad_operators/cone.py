"""Projection onto the cone of directions without a conflict: UPGrad and DualProj."""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from crossgrad_core.plugin import GramianOperator, OperatorContext, PluginState, Weighting
from crossgrad_operators._weights import extended_precision


class UPGrad(GramianOperator):
    """The mean of the gradients, each projected onto the cone of conflict-free directions.

    For each k: v_k = argmin v^T G v subject to v >= e_k / K; u is the sum of all v_k G. For two
    views u is half of the result of `symmetric`. Two views use a closed form. More views use the
    active sets of Lawson and Hanson. Gradients in float64 use 32 digits.

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
    """The mean gradient, projected onto the cone of conflict-free directions.

    v = argmin v^T G v subject to v >= 1/K; u = v G. Two views use a closed form. More views use the
    active sets of Lawson and Hanson. Gradients in float64 use 32 digits.

    Source: Lopez-Paz and Ranzato 2017; the weighting has the same name in TorchJD.
    """

    identity_at_one: ClassVar[bool] = True

    @override
    def weights(
        self, gramians: NDArray[np.float64], context: OperatorContext
    ) -> NDArray[np.float64]:
        from crossgrad_operators.numba_kernels.cone import dualproj

        return extended_precision(dualproj, gramians, context)

"""IMTL-G (Liu et al. 2021, "Towards impartial multi-task learning")."""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from crossgrad_core.operator import Operator, OperatorContext
from crossgrad_core.state import PluginState
from crossgrad_operators._weights import sharpened, weighting


class IMTLG(Operator):
    """The combination with equal projections on all unit gradients, weights adding up to 1.

    G v = (|g_k|), w = v / sum v. For two views w = (|g_2|, |g_1|) / (|g_1| + |g_2|): the bisector.
    Where G is singular, v is the shortest least-squares solution; where the v add up to zero, or
    nothing but rounding noise is left, the result is zero.
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
        from crossgrad_operators.numba_kernels.balance import imtl_g
        from crossgrad_operators.numba_kernels.exact_balance import exact_imtl_g

        weights, doubtful = imtl_g(gramians, context.present, context.unit)
        return weighting(sharpened(weights, doubtful, gramians, context, exact_imtl_g)), state

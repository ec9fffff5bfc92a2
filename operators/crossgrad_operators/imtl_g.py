"""IMTL-G (Liu et al. 2021, "Towards impartial multi-task learning")."""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from crossgrad_core.plugin import OperatorContext, Weighting
from crossgrad_operators._weights import doubted


class IMTLG(Weighting):
    """The combination with equal projections on all unit gradients, weights adding up to 1.

    G v = (|g_k|), w = v / sum v. For two views w = (|g_2|, |g_1|) / (|g_1| + |g_2|): the bisector.
    Where G is singular, v is the shortest least-squares solution; where the v add up to zero, or
    nothing but rounding noise is left, the result is zero.
    """

    identity_at_one: ClassVar[bool] = True

    @override
    def weights(
        self, gramians: NDArray[np.float64], context: OperatorContext
    ) -> NDArray[np.float64]:
        from crossgrad_operators.numba_kernels.balance import imtl_g

        return doubted(imtl_g, gramians, context)

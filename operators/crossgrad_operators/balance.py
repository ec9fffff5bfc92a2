"""Operators that balance the gradients: Aligned-MTL, IMTL-G and Nash-MTL."""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from crossgrad_core.plugin import OperatorContext, Weighting
from crossgrad_operators._weights import doubted


class Aligned(Weighting):
    """Reduction of all singular values of the gradient matrix to its smallest singular value.

    G = V L V^T; w = sqrt(l_min) V L^-1/2 V^T p with p = 1/K and l_min the smallest eigenvalue above
    K eps l_max. If an eigenvalue falls below this limit, the result u is discontinuous: the
    eigenvalue's direction is omitted, so l_min becomes the next larger eigenvalue.

    Source: Senushkin et al. 2023, "Independent component alignment".
    """

    identity_at_one: ClassVar[bool] = True

    @override
    def weights(
        self, gramians: NDArray[np.float64], context: OperatorContext
    ) -> NDArray[np.float64]:
        from crossgrad_operators.numba_kernels.balance import aligned

        return doubted(aligned, gramians, context)


class IMTLG(Weighting):
    """The combination with equal projections on all unit gradients and weights that add up to 1.

    G v = (|g_k|), w = v / sum v. For two views, w = (|g_2|, |g_1|) / (|g_1| + |g_2|): the bisector.
    If G is singular, v is the shortest least-squares solution. If the sum of v is zero, or if the
    result is only rounding noise, the result is zero.

    Source: Liu et al. 2021, "Towards impartial multi-task learning".
    """

    identity_at_one: ClassVar[bool] = True

    @override
    def weights(
        self, gramians: NDArray[np.float64], context: OperatorContext
    ) -> NDArray[np.float64]:
        from crossgrad_operators.numba_kernels.balance import imtl_g

        return doubted(imtl_g, gramians, context)


class Nash(Weighting):
    """The bargaining solution: alpha > 0 with G alpha = 1 / alpha, u = sum alpha_k g_k.

    Two views use a closed form. More views use damped Newton steps (decrement 1e-13). The length
    |u| of the plain solution is always sqrt(K). The plain solution is multiplied by the geometric
    mean of the norms. Therefore u scales with the gradients, and a single view is unchanged. The
    result is zero if the gradients are exactly opposite.

    Source: Navon et al. 2022, "Multi-task learning as a bargaining game".
    """

    identity_at_one: ClassVar[bool] = True

    @override
    def weights(
        self, gramians: NDArray[np.float64], context: OperatorContext
    ) -> NDArray[np.float64]:
        from crossgrad_operators.numba_kernels.balance import nash

        return doubted(nash, gramians, context)

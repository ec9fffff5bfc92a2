"""Operators that balance the gradients: Aligned-MTL, IMTL-G and Nash-MTL."""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from crossgrad_core.plugin import OperatorContext, Weighting
from crossgrad_operators._weights import doubted


class Aligned(Weighting):
    """All singular values of the gradient matrix are brought down to its smallest one.

    G = V L V^T; w = sqrt(l_min) V L^-1/2 V^T p with p = 1/K and l_min the smallest eigenvalue above
    K eps l_max. Where an eigenvalue falls below that, u jumps: the direction is left out and l_min
    is the next one.

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
    """The combination with equal projections on all unit gradients, weights adding up to 1.

    G v = (|g_k|), w = v / sum v. For two views w = (|g_2|, |g_1|) / (|g_1| + |g_2|): the bisector.
    Where G is singular, v is the shortest least-squares solution; where the v add up to zero, or
    nothing but rounding noise is left, the result is zero.

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

    Closed form for two views, damped Newton above (decrement 1e-13). |u| would always be sqrt(K);
    it is multiplied by the geometric mean of the norms, so that u scales with the gradients and a
    single view stays as it is. Zero where the gradients oppose each other exactly.

    Source: Navon et al. 2022, "Multi-task learning as a bargaining game".
    """

    identity_at_one: ClassVar[bool] = True

    @override
    def weights(
        self, gramians: NDArray[np.float64], context: OperatorContext
    ) -> NDArray[np.float64]:
        from crossgrad_operators.numba_kernels.balance import nash

        return doubted(nash, gramians, context)

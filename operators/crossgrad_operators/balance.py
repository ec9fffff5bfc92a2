"""Operators that balance the gradients of the views: Aligned-MTL, IMTL-G and Nash-MTL."""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from crossgrad_core.plugin import OperatorContext, Weighting
from crossgrad_operators._weights import doubted


class Aligned(Weighting):
    """Reduce all singular values of the gradient matrix to its smallest singular value.

    With the eigenvalues L and eigenvectors V of the Gramian, G = V L V^T, the weights are w =
    sqrt(l_min) V L^-1/2 V^T p. Here p = 1/K, and l_min is the smallest eigenvalue above the limit K
    eps l_max. The result is not continuous where an eigenvalue is at the limit K eps l_max. Below
    the limit, the direction of an eigenvalue is left out, and l_min becomes the next larger
    eigenvalue.

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
    """The combination with equal projections on all unit gradients, and with weights of sum 1.

    The equations are G v = (|g_k|) with the Gramian G, and w = v / sum v. For two views, w =
    (|g_2|, |g_1|) / (|g_1| + |g_2|), and the result is the bisector. If G is singular, v is the
    least-squares solution with the smallest norm. If the sum of v is zero, or if only rounding
    noise remains, the result is zero.

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
    """The Nash bargaining solution: alpha > 0 with G alpha = 1 / alpha, and u = sum alpha_k g_k.

    For two views, a closed form is used. For more views, damped Newton steps are used until the
    Newton decrement is below 1e-13. Without scaling, the length |u| would always be sqrt(K). The
    solution is therefore multiplied by the geometric mean of the gradient norms. After this
    scaling, u is proportional to the gradients, and a single view is unchanged. If the gradients
    are exactly opposite, the result is zero.

    Source: Navon et al. 2022, "Multi-task learning as a bargaining game".
    """

    identity_at_one: ClassVar[bool] = True

    @override
    def weights(
        self, gramians: NDArray[np.float64], context: OperatorContext
    ) -> NDArray[np.float64]:
        from crossgrad_operators.numba_kernels.balance import nash

        return doubted(nash, gramians, context)

"""Nash-MTL (Navon et al. 2022, "Multi-task learning as a bargaining game")."""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from crossgrad_core.plugin import OperatorContext, Weighting
from crossgrad_operators._weights import doubted


class Nash(Weighting):
    """The bargaining solution: alpha > 0 with G alpha = 1 / alpha, u = sum alpha_k g_k.

    Closed form for two views, damped Newton above (decrement 1e-13). |u| would always be sqrt(K);
    it is multiplied by the geometric mean of the norms, so that u scales with the gradients and a
    single view stays as it is. Zero where the gradients oppose each other exactly.
    """

    identity_at_one: ClassVar[bool] = True

    @override
    def weights(
        self, gramians: NDArray[np.float64], context: OperatorContext
    ) -> NDArray[np.float64]:
        from crossgrad_operators.numba_kernels.balance import nash

        return doubted(nash, gramians, context)

"""MGDA (Désidéri 2012; Sener and Koltun 2018)."""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from crossgrad_core.plugin import OperatorContext, Weighting
from crossgrad_operators._weights import extended_precision


class MGDA(Weighting):
    """The shortest convex combination of the gradients: min |sum w_k g_k|, w on the simplex.

    Closed form for two views, Lawson and Hanson's active sets above, with 32 digits for gradients
    in float64. |u| is at most the shortest gradient's length; zero where a convex combination is.
    """

    identity_at_one: ClassVar[bool] = True

    @override
    def weights(
        self, gramians: NDArray[np.float64], context: OperatorContext
    ) -> NDArray[np.float64]:
        from crossgrad_operators.numba_kernels.simplex import mgda

        return extended_precision(mgda, gramians, context)

"""Aligned-MTL (Senushkin et al. 2023, "Independent component alignment")."""

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
    """

    identity_at_one: ClassVar[bool] = True

    @override
    def weights(
        self, gramians: NDArray[np.float64], context: OperatorContext
    ) -> NDArray[np.float64]:
        from crossgrad_operators.numba_kernels.balance import aligned

        return doubted(aligned, gramians, context)

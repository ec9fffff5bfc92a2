"""DualProj (Lopez-Paz and Ranzato 2017; weighting of the same name in TorchJD)."""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from crossgrad_core.plugin import OperatorContext, Weighting
from crossgrad_operators._weights import extended_precision


class DualProj(Weighting):
    """The mean gradient, projected on the cone that conflicts with no gradient.

    v = argmin v^T G v subject to v >= 1/K; u = v G. Closed form for two views, Lawson and Hanson's
    active sets above, with 32 digits for gradients in float64.
    """

    identity_at_one: ClassVar[bool] = True

    @override
    def weights(
        self, gramians: NDArray[np.float64], context: OperatorContext
    ) -> NDArray[np.float64]:
        from crossgrad_operators.numba_kernels.cone import dualproj

        return extended_precision(dualproj, gramians, context)

"""DualProj (Lopez-Paz and Ranzato 2017; weighting of the same name in TorchJD)."""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from crossgrad_core.operator import Operator, OperatorContext
from crossgrad_core.state import PluginState
from crossgrad_operators._weights import weighting, with_digits


class DualProj(Operator):
    """The mean gradient, projected on the cone that conflicts with no gradient.

    v = argmin v^T G v subject to v >= 1/K; u = v G. Closed form for two views, Lawson and Hanson's
    active sets above, with 32 digits for gradients in float64.
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
        from crossgrad_operators.numba_kernels.cone import dualproj

        return weighting(with_digits(dualproj, gramians, context)), state

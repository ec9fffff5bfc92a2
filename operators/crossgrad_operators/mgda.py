"""MGDA (Désidéri 2012; Sener and Koltun 2018)."""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from crossgrad_core.plugin import GramianOperator, OperatorContext, PluginState
from crossgrad_operators._weights import weighting


class MGDA(GramianOperator):
    """The shortest convex combination of the gradients: min |sum w_k g_k|, w on the simplex.

    Closed form on every face: all supports for up to four views, Wolfe's method above. |u| is at
    most the shortest gradient's length; zero where the gradients oppose each other exactly.
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
        from crossgrad_operators.numba_kernels.simplex import mgda

        return weighting(mgda(gramians, context.present)), state

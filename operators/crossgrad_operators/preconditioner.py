"""Scale gradients by camera distance (arXiv 2605.00052, equation preconditioner)."""

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from typing_extensions import override

from crossgrad_core.plugin import MatrixOperator, OperatorContext, PluginState, diagonals

#: Limits of r / r_ref, so that even a camera at the centroid gets some weight.
_BOUNDS = (1e-2, 1e2)


class Preconditioner(MatrixOperator):
    """Multiply each gradient g_k by (r_k / r_ref)^d, then add the gradients.

    r_k is the distance of the camera from the mean of the training cameras. r_ref is the median of
    these distances. The ratio r_k / r_ref is clipped to [1e-2, 1e2]. The exponent d depends on the
    kind of the block. With d > 0, gradients of far views become longer, and gradients of near views
    become shorter. The operator reads no Gramian.
    """

    geometry: float = Field(2.0, description="exponent d for means, scales and rotations")
    appearance: float = Field(1.0, description="exponent d for opacity and colour")
    neutral: float = Field(1.0, description="exponent d for neutral blocks")

    @override
    def transform(
        self,
        gramians: NDArray[np.float64],
        context: OperatorContext,
        state: PluginState,
        rng: np.random.Generator,
    ) -> tuple[NDArray[np.float64], PluginState]:
        ratios = np.ones(gramians.shape[1])
        if context.reference_distance > 0:
            ratios = np.clip(context.distances / context.reference_distance, *_BOUNDS)
        places = {"geometry": 0, "appearance": 1, "neutral": 2}
        powers = np.array([self.geometry, self.appearance, self.neutral])
        table = ratios ** powers[:, None]  # [3, K]
        kinds = np.fromiter(map(places.__getitem__, context.kinds), np.int64, len(context.kinds))
        return diagonals(table[kinds]), state

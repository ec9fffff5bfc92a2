"""Magnitude-only distance preconditioner (arXiv 2605.00052, equation preconditioner)."""

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from typing_extensions import override

from crossgrad_core.plugin import MatrixOperator, OperatorContext, PluginState, diagonals

#: Limits of r / r_ref, so that a camera at the centroid keeps some weight.
_BOUNDS = (1e-2, 1e2)


class Preconditioner(MatrixOperator):
    """Multiplication of each g_k by (r_k / r_ref)^d before the gradients are added.

    r_k is the distance of the camera from the mean training camera, and r_ref is the median of
    these distances. The ratio is clipped to [1e-2, 1e2]. The exponent depends on the kind of the
    block. Gradients of far views become longer, and gradients of near views shorter. No Gramian is
    used.
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

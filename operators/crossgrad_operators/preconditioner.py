"""Magnitude-only distance preconditioner (arXiv 2605.00052, equation preconditioner)."""

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from typing_extensions import override

from crossgrad_core.plugin import MatrixOperator, OperatorContext, PluginState, diagonals

#: Bounds of r / r_ref: a camera at the centroid must not lose all weight.
_BOUNDS = (1e-2, 1e2)


class Preconditioner(MatrixOperator):
    """g_k is multiplied by (r_k / r_ref)^d; then the gradients are added.

    r_k is the distance of the camera from the mean training camera, r_ref the median of these, and
    their ratio is kept within [1e-2, 1e2]. The exponent depends on the kind of the block. Gradients
    of far views grow, those of near views shrink. No Gramian is looked at.
    """

    geometry: float = Field(2.0, description="exponent d for means, scales and rotations")
    appearance: float = Field(1.0, description="exponent d for opacity and colour")
    neutral: float = Field(1.0, description="exponent d for blocks of neither kind")

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

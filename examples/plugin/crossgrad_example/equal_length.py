"""An operator in which every view has the same influence, even if gradients differ in length."""

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import OperatorContext, Weighting


class EqualLength(Weighting):
    """An operator that scales the K gradients of a block to their mean length and adds them."""

    def weights(
        self, gramians: NDArray[np.float64], context: OperatorContext
    ) -> NDArray[np.float64]:
        lengths = np.sqrt(np.einsum("bkk->bk", gramians))  # [B, K]
        mean = lengths.sum(axis=1) / np.maximum(context.present.sum(axis=1), 1)  # [B]
        return np.divide(mean[:, None], lengths, out=np.zeros_like(lengths), where=context.present)

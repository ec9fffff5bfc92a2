"""How the gradients of K views become one."""

import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from crossgrad_core.plugin import Field, OperatorContext, Weighting


class Template(Weighting):
    """Adds the views' gradients with one weight."""

    weight: float = Field(1.0, gt=0.0, le=1.0, description="of every view")

    @override
    def weights(
        self, gramians: NDArray[np.float64], context: OperatorContext
    ) -> NDArray[np.float64]:
        return np.where(context.present, self.weight, 0.0)

"""From the coordinates of a scene's input to those that are trained in."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Similarity:
    """x_local = (x_input - offset) * scale, in float64; the rotation is the identity.

    Attributes:
        offset: [3] float64, input frame.
        scale: Local units per input unit.
    """

    offset: NDArray[np.float64]
    scale: float

    def to_local(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """[N, 3] points of the input frame in the local frame."""
        return (points - self.offset) * self.scale

    def to_input(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """[N, 3] points of the local frame in the input frame."""
        return points / self.scale + self.offset

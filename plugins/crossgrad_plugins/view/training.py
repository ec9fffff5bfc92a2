"""The state of a training run as its viewer shows it, and the user's requests to the run."""

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

_Curve = tuple[NDArray[np.float64], NDArray[np.float64]]
#: Largest number of points of a curve. A longer curve is thinned to half of its points.
_MOST: Final = 400
#: Weight of the newest step in the moving average of the loss.
_NEWEST: Final = 0.05


@dataclass
class Training:
    """A run in training.

    Attributes:
        paused: True if the user paused the run.
        stopping: True if the user stopped the run.
        text: One line about the progress.
        losses: Pairs of step and moving average of the training loss.
        scores: Pairs of step and PSNR of the held-out views in dB.
    """

    paused: bool = False
    stopping: bool = False
    text: str = ""
    losses: list[tuple[float, float]] = field(default_factory=list)
    scores: list[tuple[float, float]] = field(default_factory=list)
    _mean: float | None = None
    _every: int = 1

    def add_loss(self, step: int, loss: float) -> None:
        """Add the loss of a step to its moving average."""
        self._mean = loss if self._mean is None else self._mean + _NEWEST * (loss - self._mean)
        if step % self._every:
            return
        self.losses.append((float(step), self._mean))
        if len(self.losses) > _MOST:
            self._every *= 2
            self.losses = self.losses[1::2]

    @staticmethod
    def curve(points: list[tuple[float, float]]) -> _Curve:
        """Return steps and values as arrays; a curve without points gets one undefined point."""
        table = np.array(points or [(0.0, np.nan)], dtype=np.float64)
        return table[:, 0].copy(), table[:, 1].copy()

"""The metric slot: a figure of merit of each held-out view."""

from abc import abstractmethod
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_core.contract.component import Component
from crossgrad_core.contract.figure import Figure
from crossgrad_core.contract.scene import View


@dataclass(frozen=True, eq=False)
class Compared:
    """A held-out view beside its photo, as results compare them. Nothing in it may be changed.

    Attributes:
        view: The view.
        render: [H, W, 3] uint8 on the CPU, rounded as if it had been written to a file.
        photo: [H, W, 3] uint8.
        mask: [H, W] bool, True where the pixel counts; None where every pixel counts.
        drawn: [H, W, 3] floating point on the CPU, the render before clamping and rounding; None
            where only the rounded one is there.
        points: [S, 3] SfM points that the view observed, local frame; may be empty.
    """

    view: View
    render: Tensor
    photo: Tensor
    mask: Tensor | None
    drawn: Tensor | None = None
    points: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))


class Metric(Component):
    """Measures one figure of every held-out view.

    Attributes:
        figure: What the figure is called and how it is shown.
    """

    slot: ClassVar[str] = "metrics"
    figure: ClassVar[Figure]

    def described(self) -> Figure:
        """The figure as the metric measures it with its options; by default `figure`.

        Its definition and the reason why there is none may depend on them, its name may not.
        """
        return self.figure

    @abstractmethod
    def measure(self, compared: Compared) -> float | None:
        """The figure of one view; None where there is none, such as without a pixel that counts."""

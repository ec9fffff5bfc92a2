"""The metric slot: a component measures the quality of each held-out view."""

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
    """A held-out view with the render and the photo that a metric compares.

    Metrics must not change this object or its tensors.

    Attributes:
        view: The view.
        render: [H, W, 3] uint8 on the CPU, rounded as in an image file.
        photo: [H, W, 3] uint8.
        mask: [H, W] bool, True where the pixel counts; None if every pixel counts.
        drawn: [H, W, 3] floating point on the CPU, the render before clamping and rounding; None if
            only the rounded render is known.
        points: [S, 3] SfM points that the view observed, local frame; may be empty.
    """

    view: View
    render: Tensor
    photo: Tensor
    mask: Tensor | None
    drawn: Tensor | None = None
    points: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))


class Metric(Component):
    """A component that measures one metric of every held-out view.

    Attributes:
        figure: Name and format of the metric.
    """

    slot: ClassVar[str] = "metrics"
    figure: ClassVar[Figure]

    def described(self) -> Figure:
        """Return the description of the metric with its options; by default `figure`.

        The fields `definition` and `undefined` may depend on the options, but the name must not.
        """
        return self.figure

    @abstractmethod
    def measure(self, compared: Compared) -> float | None:
        """Return the metric of one view; None if undefined, for example if no pixel counts."""

"""The loss slot: how far a render is from its photo."""

from abc import abstractmethod
from typing import ClassVar

from torch import Tensor

from crossgrad_core.contract.component import Component


class Loss(Component):
    """The photometric loss of one view, which training brings down."""

    slot: ClassVar[str] = "losses"

    @abstractmethod
    def loss(
        self, render: Tensor, photo: Tensor, mask: Tensor | None, weights: Tensor | None
    ) -> Tensor:
        """How far the render is from the photo: a scalar, differentiable in the render.

        A mean over the pixels that count, so that images of different sizes compare. Without a
        pixel that counts it is 0.

        Args:
            render: [H, W, 3] floating point; values may lie outside [0, 1].
            photo: [H, W, 3] uint8 (255 means 1) or floating point, on the render's device.
            mask: [H, W] bool, True where the pixel counts; None where every pixel counts. A pixel
                that does not count adds nothing, and the render gets no gradient there.
            weights: [H, W] float32, not negative: how much each pixel counts beside the others.
                Only their ratios matter; None weighs all pixels alike.
        """

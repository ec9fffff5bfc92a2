"""The loss slot: the difference between a render and its photo."""

from abc import abstractmethod
from typing import ClassVar

from torch import Tensor

from crossgrad_core.contract.component import Component


class Loss(Component):
    """The photometric loss of one view, which training minimises."""

    slot: ClassVar[str] = "losses"

    @abstractmethod
    def loss(
        self, render: Tensor, photo: Tensor, mask: Tensor | None, weights: Tensor | None
    ) -> Tensor:
        """Return the loss between render and photo, a scalar that is differentiable in the render.

        The loss is a mean over the pixels that count, so that losses of images of different sizes
        are comparable. If no pixel counts, the loss is 0.

        Args:
            render: [H, W, 3] floating point; values may lie outside [0, 1].
            photo: [H, W, 3] uint8 (255 means 1) or floating point, on the render's device.
            mask: [H, W] bool, True where the pixel counts; None if every pixel counts. A pixel that
                does not count adds nothing to the loss, and the render gets no gradient in this
                pixel.
            weights: [H, W] float32, not negative: relative weight of each pixel. Only the ratios of
                the weights have an effect; None gives all pixels equal weight.
        """

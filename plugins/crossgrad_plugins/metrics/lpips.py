"""LPIPS with AlexNet."""

from typing import ClassVar

from torch import Tensor
from typing_extensions import override

from crossgrad_core.plugin import Figure
from crossgrad_plugins.metrics.perceptual.metric import IN_FULL_RANGE, Perceptual, figure_of
from crossgrad_plugins.metrics.perceptual.trunks import ALEXNET, Trunk


class LPIPS(Perceptual):
    """Learned perceptual similarity with AlexNet, images in [-1, 1]; lower is better."""

    net: ClassVar[Trunk] = ALEXNET
    entry: ClassVar[str] = "lpips"
    figure: ClassVar[Figure] = figure_of("lpips", "LPIPS", ALEXNET, entry, IN_FULL_RANGE)

    @override
    def entering(self, image: Tensor) -> Tensor:
        return 2 * image - 1

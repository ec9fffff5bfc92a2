"""LPIPS with VGG-16."""

from typing import ClassVar

from torch import Tensor
from typing_extensions import override

from crossgrad_core.plugin import Figure
from crossgrad_plugins.metrics.perceptual.metric import IN_FULL_RANGE, Perceptual, figure_of
from crossgrad_plugins.metrics.perceptual.trunks import VGG16, Trunk


class LPIPSOfVGG(Perceptual):
    """Learned perceptual similarity with VGG-16, images in [-1, 1]; lower is better."""

    net: ClassVar[Trunk] = VGG16
    entry: ClassVar[str] = "lpips-vgg"
    figure: ClassVar[Figure] = figure_of("lpips_vgg", "LPIPS (VGG)", VGG16, entry, IN_FULL_RANGE)

    @override
    def entering(self, image: Tensor) -> Tensor:
        return 2 * image - 1

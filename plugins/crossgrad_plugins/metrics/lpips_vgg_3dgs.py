"""LPIPS with VGG-16 as the 3DGS family reports it."""

from typing import ClassVar

from torch import Tensor
from typing_extensions import override

from crossgrad_core.plugin import Figure
from crossgrad_plugins.metrics.perceptual.metric import IN_UNIT_RANGE, Perceptual, figure_of
from crossgrad_plugins.metrics.perceptual.trunks import VGG16, Trunk


class LPIPSOfVGGAs3DGS(Perceptual):
    """Learned perceptual similarity with VGG-16, images in [0, 1] as 3DGS feeds them.

    Made for images in [-1, 1], the network sees low contrast; the figure compares with those that
    papers of the 3DGS family give, and with no other LPIPS.
    """

    net: ClassVar[Trunk] = VGG16
    entry: ClassVar[str] = "lpips-vgg-3dgs"
    figure: ClassVar[Figure] = figure_of(
        "lpips_vgg_3dgs", "LPIPS (VGG, 3DGS)", VGG16, entry, IN_UNIT_RANGE
    )

    @override
    def entering(self, image: Tensor) -> Tensor:
        return image

"""The place of LPIPS in the results."""

from typing import ClassVar

from typing_extensions import override

from crossgrad_core.plugin import Compared, Figure, Metric


class LPIPS(Metric):
    """Learned perceptual similarity: null, because no package brings the weights of its network.

    The column is there for those who fill it.
    """

    figure: ClassVar[Figure] = Figure(
        name="lpips",
        label="LPIPS",
        undefined="LPIPS needs the pretrained AlexNet or VGG trunk, which no Python package ships; "
        "it is not computed",
    )

    @override
    def measure(self, compared: Compared) -> float | None:
        return None

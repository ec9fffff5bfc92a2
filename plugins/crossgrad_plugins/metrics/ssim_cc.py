"""Structural similarity after colour correction."""

from typing import ClassVar

from typing_extensions import override

from crossgrad_core.plugin import Compared, Figure, Metric
from crossgrad_plugins.metrics.color_correction import DEFINITION, color_corrected
from crossgrad_plugins.metrics.similarity import ssim


class ColorCorrectedSSIM(Metric):
    """SSIM (3DGS form) of the render whose colours are fitted to the photo."""

    figure: ClassVar[Figure] = Figure(
        name="ssim_cc", label="SSIM (cc)", definition=f"SSIM (3DGS form) {DEFINITION}"
    )

    @override
    def measure(self, compared: Compared) -> float | None:
        corrected = color_corrected(compared)
        return None if corrected is None else ssim(corrected, compared.photo, compared.mask)

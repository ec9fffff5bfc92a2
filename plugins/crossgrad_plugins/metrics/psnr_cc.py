"""Peak signal-to-noise ratio after colour correction."""

from typing import ClassVar

from typing_extensions import override

from crossgrad_core.plugin import Compared, Figure, Metric, psnr
from crossgrad_plugins.metrics.color_correction import DEFINITION, color_corrected


class ColorCorrectedPSNR(Metric):
    """PSNR of the render whose colours are fitted to the photo, which it therefore looks at.

    Beside `psnr` it tells errors of brightness and white balance from errors of the scene.
    """

    figure: ClassVar[Figure] = Figure(
        name="psnr_cc", label="PSNR (cc)", form=".2f", definition=f"dB; PSNR {DEFINITION}"
    )

    @override
    def measure(self, compared: Compared) -> float | None:
        corrected = color_corrected(compared)
        return None if corrected is None else psnr(corrected, compared.photo, compared.mask)

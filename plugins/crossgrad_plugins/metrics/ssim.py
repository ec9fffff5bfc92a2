"""Structural similarity as the 3DGS family computes it."""

from typing import ClassVar

from typing_extensions import override

from crossgrad_core.plugin import Compared, Figure, Metric
from crossgrad_plugins.metrics.similarity import ssim


class SSIM(Metric):
    """Structural similarity in the form of 3DGS: 11 x 11 window, sigma 1.5, zero padding."""

    figure: ClassVar[Figure] = Figure(
        name="ssim",
        label="SSIM",
        per_regime=True,
        definition="3DGS form: 11 x 11 window, sigma 1.5, zero padding, mean over images",
    )

    @override
    def measure(self, compared: Compared) -> float | None:
        return ssim(compared.render, compared.photo, compared.mask)

"""Peak signal-to-noise ratio."""

from typing import ClassVar

from typing_extensions import override

from crossgrad_core.plugin import Compared, Figure, Metric, psnr


class PSNR(Metric):
    """Peak signal-to-noise ratio over the unmasked pixels and their channels, in dB.

    For identical images, the result is 100 dB. Source: evaluation script of 3DGS.
    """

    figure: ClassVar[Figure] = Figure(
        name="psnr",
        label="PSNR",
        form=".2f",
        per_regime=True,
        definition="dB; 20 log10(1 / sqrt(mse)) per image over all channels, mean over images",
    )

    @override
    def measure(self, compared: Compared) -> float | None:
        return psnr(compared.render, compared.photo, compared.mask)

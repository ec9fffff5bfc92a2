"""Structural similarity as scikit-image computes it."""

from typing import ClassVar

from typing_extensions import override

from crossgrad_core.plugin import Compared, Figure, Metric
from crossgrad_plugins.metrics.similarity import SSIM_SKIMAGE_TOO_SMALL, ssim_skimage


class SSIMOfSkimage(Metric):
    """Structural similarity of scikit-image: Gaussian weights, sigma 1.5, no sample covariance."""

    figure: ClassVar[Figure] = Figure(
        name="ssim_skimage",
        label="SSIM (skimage)",
        definition="scikit-image: gaussian_weights, sigma 1.5, use_sample_covariance off",
        undefined=SSIM_SKIMAGE_TOO_SMALL,
    )

    @override
    def measure(self, compared: Compared) -> float | None:
        return ssim_skimage(compared.render, compared.photo, compared.mask)

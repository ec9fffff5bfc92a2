"""Structural similarity (SSIM), computed as in the 3DGS code and as in scikit-image.

Both metrics first clamp the images to [0, 1] and round them to 8 bits, as if the render were
written to a file. With a mask, only unmasked pixels count, and masked pixels are set to 0 in both
images.
"""

from concurrent.futures import ThreadPoolExecutor
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from typing_extensions import override

from crossgrad_core.plugin import Compared, Figure, Metric, masked, to_uint8
from crossgrad_plugins.losses.photometric.reference import RADIUS, SIGMA, WINDOW

SSIM_SKIMAGE_TOO_SMALL = (
    f"scikit-image's SSIM needs kept pixels at least {RADIUS} pixels from the border, "
    f"in an image of {WINDOW} x {WINDOW} or more"
)
#: Number of rows that a thread processes at the same time, so that intermediate results stay in the
#: cache.
_ROWS = 128


class SSIM(Metric):
    """Structural similarity as in the 3DGS code: 11 x 11 window, sigma 1.5, zero padding."""

    figure: ClassVar[Figure] = Figure(
        name="ssim",
        label="SSIM",
        per_regime=True,
        definition="3DGS form: 11 x 11 window, sigma 1.5, zero padding, mean over images",
    )

    @override
    def measure(self, compared: Compared) -> float | None:
        return ssim(compared.render, compared.photo, compared.mask)


class SSIMOfSkimage(Metric):
    """Structural similarity of scikit-image with Gaussian weights and sigma 1.5.

    It uses no sample covariance.
    """

    figure: ClassVar[Figure] = Figure(
        name="ssim_skimage",
        label="SSIM (skimage)",
        definition="scikit-image: gaussian_weights, sigma 1.5, use_sample_covariance off",
        undefined=SSIM_SKIMAGE_TOO_SMALL,
    )

    @override
    def measure(self, compared: Compared) -> float | None:
        return ssim_skimage(compared.render, compared.photo, compared.mask)


def ssim(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float | None:
    """Return the SSIM as in the loss: 11 x 11 Gaussian window, sigma 1.5, zero padding.

    The arguments are those of `psnr`. The result is the mean over the unmasked pixels, or None if
    all pixels are masked.
    """
    from crossgrad_plugins.losses.photometric.numba_kernels.fused import loss_terms

    if _keeps_nothing(image, mask):
        return None
    rendered = (to_uint8(image).to(torch.float32) / 255).contiguous().numpy()
    photo = to_uint8(target).contiguous().numpy()
    kept = None if mask is None else mask.cpu().contiguous().numpy()
    return 1 - loss_terms(rendered, photo, kept)[1]


def ssim_skimage(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float | None:
    """Return the SSIM of scikit-image with Gaussian weights and sigma 1.5.

    It uses no sample covariance. As in scikit-image, a border of 5 pixels is left out of the mean,
    because windows there extend beyond the image.

    The arguments are those of `psnr`. The result is None if no pixel is left;
    `SSIM_SKIMAGE_TOO_SMALL` states the reason.
    """
    height, width = image.shape[:2]
    inside = torch.zeros(height, width, dtype=torch.bool)
    inside[RADIUS : height - RADIUS, RADIUS : width - RADIUS] = True
    if mask is not None:
        inside &= mask.cpu()
    if min(height, width) < WINDOW or not bool(inside.any()):
        return None
    return float(_skimage_map(image, target, mask)[inside.numpy()].mean())


def _skimage_map(image: Tensor, target: Tensor, mask: Tensor | None) -> NDArray[np.float64]:
    """Return [H, W, 3] SSIM per pixel and channel; a border of RADIUS pixels is undefined.

    A value depends only on pixels within RADIUS, so processing in strips gives the same bits as the
    whole image.
    """
    from skimage.metrics import structural_similarity

    mask = None if mask is None else mask.cpu()
    rendered, photo = (masked(to_uint8(picture), mask).numpy() for picture in (image, target))
    height = len(rendered)
    ssim_map = np.empty(rendered.shape)

    def work(start: int) -> None:
        stop = min(start + _ROWS, height)
        # Add rows above the last strip, because it may have too few rows for a window.
        first = max(min(start - RADIUS, height - WINDOW), 0)
        last = min(stop + RADIUS, height)
        _, full = structural_similarity(
            rendered[first:last] / 255,
            photo[first:last] / 255,
            gaussian_weights=True,
            sigma=SIGMA,
            use_sample_covariance=False,
            data_range=1.0,
            channel_axis=-1,
            full=True,
        )
        ssim_map[start:stop] = full[start - first : stop - first]

    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        list(pool.map(work, range(0, height, _ROWS)))
    return ssim_map


def _keeps_nothing(image: Tensor, mask: Tensor | None) -> bool:
    return image.numel() == 0 if mask is None else not bool(mask.any())

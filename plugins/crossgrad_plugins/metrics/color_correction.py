"""PSNR and SSIM of the render after its colours are fitted to the photo."""

from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from typing_extensions import override

from crossgrad_core.plugin import Compared, Figure, Metric, psnr
from crossgrad_plugins.metrics.ssim import ssim

#: Definition that summary.json contains for every colour-corrected metric.
DEFINITION = (
    "of the render after the affine map of RGB (3 x 4, 8-bit sRGB values) that brings it closest "
    "to the photo of the view by least squares over the pixels that count; "
    "clamped and rounded to 8 bits again"
)
#: If the render's colours vary less than this share along a direction, compared with the widest
#: direction, the direction counts as constant. A grey render has two constant directions, apart
#: from rounding errors.
_FLAT = 1e-10
#: Number of pixels that are processed at the same time, so that intermediate results stay in the
#: cache.
_AT_ONCE = 2**15
Floats = NDArray[np.float64]
Bytes = NDArray[np.uint8]


class ColorCorrectedPSNR(Metric):
    """PSNR of the render after its colours are fitted to the photo.

    The metric uses the photo. Compared with `psnr`, it separates errors of brightness and white
    balance from errors of the scene.
    """

    figure: ClassVar[Figure] = Figure(
        name="psnr_cc", label="PSNR (cc)", form=".2f", definition=f"dB; PSNR {DEFINITION}"
    )

    @override
    def measure(self, compared: Compared) -> float | None:
        corrected = color_corrected(compared)
        return None if corrected is None else psnr(corrected, compared.photo, compared.mask)


class ColorCorrectedSSIM(Metric):
    """SSIM (3DGS form) of the render after its colours are fitted to the photo."""

    figure: ClassVar[Figure] = Figure(
        name="ssim_cc", label="SSIM (cc)", definition=f"SSIM (3DGS form) {DEFINITION}"
    )

    @override
    def measure(self, compared: Compared) -> float | None:
        corrected = color_corrected(compared)
        return None if corrected is None else ssim(corrected, compared.photo, compared.mask)


def color_corrected(compared: Compared) -> Tensor | None:
    """Return [H, W, 3] uint8: the render after the affine colour map that best fits the photo.

    The map is fitted to unmasked pixels and applied to all pixels. The result is None if all pixels
    are masked.
    """
    render, photo = (_kept(image, compared.mask) for image in (compared.render, compared.photo))
    if not len(render):
        return None
    matrix, offset = _fit(render, photo)
    pixels = compared.render.reshape(-1, 3).numpy()
    corrected = np.empty_like(pixels)
    for at in range(0, len(pixels), _AT_ONCE):
        fitted = pixels[at : at + _AT_ONCE] @ matrix + offset
        corrected[at : at + _AT_ONCE] = np.rint(np.clip(fitted, 0.0, 255.0))
    return torch.from_numpy(corrected).reshape(compared.render.shape)


def _kept(image: Tensor, mask: Tensor | None) -> Bytes:
    """Return [N, 3] colours of the unmasked pixels."""
    kept = image.reshape(-1, 3) if mask is None else image[mask]
    return kept.numpy()


def _fit(render: Bytes, photo: Bytes) -> tuple[Floats, Floats]:
    """Return matrix [3, 3] and offset [3] that bring the render closest to the photo.

    The mapped colours are `render @ matrix + offset`. Render and photo are given as [N, 3] colours.
    If several maps are equally close, the map with the smallest matrix is used.
    """
    sums = _sums(render, photo)
    within, across = _spread(sums, slice(0, 3)), _spread(sums, slice(3, 6))
    matrix = np.linalg.pinv(within, rcond=_FLAT, hermitian=True) @ across
    mean_render, mean_photo = np.split(sums[6, :6] / len(render), 2)
    return matrix, mean_photo - mean_render @ matrix


def _sums(render: Bytes, photo: Bytes) -> Floats:
    """Return [7, 7] sums of products of the render's channels, the photo's channels and 1.

    float64 represents these whole numbers exactly, so the order of addition does not matter.
    """
    total = np.zeros((7, 7))
    for at in range(0, len(render), _AT_ONCE):
        rows = slice(at, at + _AT_ONCE)
        values = np.ones((len(render[rows]), 7))
        values[:, :3], values[:, 3:6] = render[rows], photo[rows]
        total += values.T @ values
    return total


def _spread(sums: Floats, others: slice) -> Floats:
    """Return [3, 3] covariances between the render's channels and other channels.

    Differences are computed with integers, so the result does not depend on rounding or threads.
    """
    exact = [[int(value) for value in row] for row in sums]
    count = exact[6][6]
    return np.array(
        [
            [(count * exact[i][j] - exact[6][i] * exact[6][j]) / count**2 for j in range(6)[others]]
            for i in range(3)
        ]
    )

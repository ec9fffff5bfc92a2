"""The spectrum of photos: how much of it is left at a smaller size."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_core.plugin import View

#: Shares are known at so many scales, 1 / GRID to 1.
GRID = 256
#: Photos are looked at in a window of so many pixels a side at most, in their middle: the share of
#: the spectrum that a scale keeps is the same in a part, but not in a smaller copy.
_WINDOW = 1024
#: Photos that are decoded at once; more of them would take memory.
_AT_ONCE = 2

#: A frequency that a scale just keeps may have been rounded up.
_ROUNDING = 1e-9

Floats = NDArray[np.float64]


def kept_shares(views: Sequence[View]) -> Floats:
    """[GRID + 1] X(F_r) / X(F) at the scales 0, 1 / GRID .. 1: what is left of the spectrum.

    X(F) is the sum of the amplitudes |DFT| of the grey photos, X(F_r) that of the frequencies that
    a photo of 1 / r of the size has: those of at most 1 / r of the highest one, in x and in y. One
    thread works on each photo and sums are in the order of the photos, so that no bit depends on
    threads. Photos without an amplitude keep all at every scale.

    Args:
        views: The views, at least one.

    Raises:
        UserError: A photo cannot be decoded.

    Source: DashGaussian (arXiv 2503.18402).
    """
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        sums = np.sum(list(pool.map(_of_view, views)), axis=0)
    return np.asarray(sums / sums[-1] if sums[-1] > 0.0 else np.ones(GRID + 1))


def _of_view(view: View) -> Floats:
    photo = view.photo
    return amplitudes_within(grey_window(photo.image(), photo.mask()))


def grey_window(image: Tensor, mask: Tensor | None) -> Floats:
    """[h, w] the middle of a photo in grey, 0 to 255; the mean where pixels do not count.

    Args:
        image: [H, W, 3] uint8.
        mask: [H, W] bool; None where every pixel counts.
    """
    top, left = (max(0, (size - _WINDOW) // 2) for size in image.shape[:2])
    part = slice(top, top + _WINDOW), slice(left, left + _WINDOW)
    grey = np.asarray(image[part].numpy().mean(axis=2, dtype=np.float64))
    if mask is not None:
        counts = mask[part].numpy()
        grey[~counts] = grey[counts].mean() if counts.any() else 0.0
    return grey


def amplitudes_within(grey: Floats) -> Floats:
    """[GRID + 1] the sum of the amplitudes |DFT| of the frequencies that each scale keeps.

    Args:
        grey: [H, W].
    """
    height, width = grey.shape
    amplitudes = np.abs(np.fft.rfft2(grey))
    # Of a real image the other half of the columns is the same, but for the first and, of an even
    # number, the last one.
    amplitudes[:, 1 : (width + 1) // 2] *= 2.0
    cells = np.maximum.outer(_cells(np.fft.fftfreq(height)), _cells(np.fft.rfftfreq(width)))
    return np.cumsum(np.bincount(cells.ravel(), amplitudes.ravel(), GRID + 1))


def _cells(frequencies: NDArray[np.floating]) -> NDArray[np.int64]:
    """Number of the first scale that keeps each frequency, cycles per pixel in [-1/2, 1/2]."""
    return np.asarray(np.ceil(2.0 * GRID * np.abs(frequencies) - _ROUNDING), dtype=np.int64)

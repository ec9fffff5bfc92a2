"""The light of an image where it shows SfM points."""

from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_core.plugin import Camera
from crossgrad_plugins.exposures.srgb import decoded

#: Linear light in [0, 1] that a photo tells: below it is noise, above it is cut off.
DARKEST, BRIGHTEST = 0.02, 0.98
_NEIGHBOURS = tuple((down, right) for down in (-1, 0, 1) for right in (-1, 0, 1))


@dataclass(frozen=True, eq=False)
class Light:
    """The brightness of an image at some points.

    Attributes:
        rows: [S] which of the points that were asked for lie in the image.
        brightness: [S] linear light, mean over 3 x 3 pixels and the channels; 1 is white.
    """

    rows: NDArray[np.int64]
    brightness: NDArray[np.float64]

    @property
    def usable(self) -> NDArray[np.bool_]:
        """[S] where the brightness is neither too dark nor cut off."""
        return (self.brightness > DARKEST) & (self.brightness < BRIGHTEST)


def light_at(
    image: Tensor, mask: Tensor | None, camera: Camera, points: NDArray[np.float64]
) -> Light:
    """The light of an image where it shows points.

    Args:
        image: [H, W, 3] sRGB values, uint8 or floating point, on the CPU.
        mask: [H, W] bool, True where the pixel counts; None where every pixel counts.
        camera: Its camera.
        points: [P, 3] points that it shows, local frame.
    """
    pixels, depths = camera.project(points)
    height, width = image.shape[:2]
    # The neighbours lie in the image, too; numbers too large for an index are sorted out before.
    inside = (pixels >= 1.0).all(axis=1) & (pixels < [width - 1, height - 1]).all(axis=1)
    rows = np.flatnonzero(inside & (depths > 0.0))
    right, down = (pixels[rows, axis].astype(np.int64) for axis in (0, 1))
    if mask is not None:
        counts = mask.numpy()
        kept = np.all([counts[down + y, right + x] for y, x in _NEIGHBOURS], axis=0)
        rows, right, down = rows[kept], right[kept], down[kept]
    values = image.numpy()
    light = sum(_linear(values[down + y, right + x]) for y, x in _NEIGHBOURS)
    return Light(rows, np.asarray(light).reshape(-1, 3).mean(axis=1) / len(_NEIGHBOURS))


def _linear(values: NDArray[np.generic]) -> NDArray[np.float64]:
    """[S, 3] sRGB values in linear light."""
    if values.dtype == np.uint8:
        return np.asarray(_of_eight_bits()[values])
    return np.asarray(decoded(torch.from_numpy(values.astype(np.float64))))


@cache
def _of_eight_bits() -> NDArray[np.float64]:
    """[256] linear light of each 8-bit value."""
    return np.asarray(decoded(torch.arange(256, dtype=torch.float64) / 255.0))

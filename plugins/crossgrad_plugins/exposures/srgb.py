"""The curve of sRGB, and gains in linear light in plain torch: the reference of the kernels.

Source: IEC 61966-2-1. Renders also contain values outside [0, 1], so the first and the last part of
the curve are extended.
"""

from typing import Final

import torch
from torch import Tensor

#: Largest encoded and largest linear value of the straight part of the curve.
THRESHOLD: Final = 0.04045
THRESHOLD_LINEAR: Final = 0.0031308
SLOPE: Final = 12.92
OFFSET: Final = 0.055
STRETCH: Final = 1.0 + OFFSET
EXPONENT: Final = 2.4


def decoded(values: Tensor) -> Tensor:
    """Return the linear light of sRGB values of any shape."""
    # `where` evaluates both branches, so the unused branch must also have a finite gradient.
    power = ((values.clamp(min=THRESHOLD) + OFFSET) / STRETCH) ** EXPONENT
    return torch.where(values <= THRESHOLD, values / SLOPE, power)


def encoded(light: Tensor) -> Tensor:
    """Return the sRGB values of linear light of any shape; the inverse of `decoded`."""
    power = STRETCH * light.clamp(min=THRESHOLD_LINEAR) ** (1.0 / EXPONENT) - OFFSET
    return torch.where(light <= THRESHOLD_LINEAR, SLOPE * light, power)


def with_gain(image: Tensor, stops: Tensor) -> Tensor:
    """Return the image [H, W, 3] with 2^stops times the light.

    `stops` is one number, or one number per channel.
    """
    return encoded(torch.exp2(stops) * decoded(image))

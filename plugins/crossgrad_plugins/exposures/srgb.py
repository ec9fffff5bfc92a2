"""The curve of sRGB, and gains in linear light in plain torch: the reference of the kernels.

Source: IEC 61966-2-1. Renders lie outside [0, 1], too: the curve goes on as it begins and ends.
"""

from typing import Final

import torch
from torch import Tensor

#: Encoded values up to here, and linear ones up to `THRESHOLD_LINEAR`, lie on the straight part.
THRESHOLD: Final = 0.04045
THRESHOLD_LINEAR: Final = 0.0031308
SLOPE: Final = 12.92
OFFSET: Final = 0.055
STRETCH: Final = 1.0 + OFFSET
EXPONENT: Final = 2.4


def decoded(values: Tensor) -> Tensor:
    """Linear light of sRGB values of any shape."""
    # What the other branch makes of values that are not its own must have a finite gradient.
    power = ((values.clamp(min=THRESHOLD) + OFFSET) / STRETCH) ** EXPONENT
    return torch.where(values <= THRESHOLD, values / SLOPE, power)


def encoded(light: Tensor) -> Tensor:
    """Values in sRGB of linear light of any shape; the inverse of `decoded`."""
    power = STRETCH * light.clamp(min=THRESHOLD_LINEAR) ** (1.0 / EXPONENT) - OFFSET
    return torch.where(light <= THRESHOLD_LINEAR, SLOPE * light, power)


def with_gain(image: Tensor, stops: Tensor) -> Tensor:
    """The image [H, W, 3] with 2^stops times the light; `stops` are one number or one a channel."""
    return encoded(torch.exp2(stops) * decoded(image))

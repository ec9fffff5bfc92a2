"""The sRGB curve and gains in linear light in plain torch: the reference for the kernels.

Source: IEC 61966-2-1. Renders also contain values outside [0, 1], so the curve is extended below 0
and above 1.
"""

from typing import Final

import torch
from torch import Tensor

#: Upper end of the linear part of the curve: as sRGB value and as linear light.
THRESHOLD: Final = 0.04045
THRESHOLD_LINEAR: Final = 0.0031308
SLOPE: Final = 12.92
OFFSET: Final = 0.055
STRETCH: Final = 1.0 + OFFSET
EXPONENT: Final = 2.4


def decoded(values: Tensor) -> Tensor:
    """Return the linear light of sRGB values; any shape."""
    # `where` evaluates both branches, so the branch that is not used must also have a finite
    # gradient.
    power = ((values.clamp(min=THRESHOLD) + OFFSET) / STRETCH) ** EXPONENT
    return torch.where(values <= THRESHOLD, values / SLOPE, power)


def encoded(light: Tensor) -> Tensor:
    """Return the sRGB values of linear light, the inverse of `decoded`; any shape."""
    power = STRETCH * light.clamp(min=THRESHOLD_LINEAR) ** (1.0 / EXPONENT) - OFFSET
    return torch.where(light <= THRESHOLD_LINEAR, SLOPE * light, power)


def with_gain(image: Tensor, stops: Tensor) -> Tensor:
    """Return the image [H, W, 3] with 2^stops times the light.

    `stops` is one number, or one number per channel.
    """
    return encoded(torch.exp2(stops) * decoded(image))

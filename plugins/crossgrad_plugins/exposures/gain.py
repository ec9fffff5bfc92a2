"""Gains in linear light: one per photo, or one per photo and channel."""

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor
from typing_extensions import override

from crossgrad_plugins.exposures.light import with_gain
from crossgrad_plugins.exposures.per_photo import ExposurePerPhoto


class Gain(ExposurePerPhoto):
    """Each photo shows 2^stops times the light of the scene; the mean of the stops is 0.

    The sRGB values of the render are converted to linear light, multiplied and converted back. The
    shutter, aperture and sensitivity of a real camera change the light by such a factor, too.
    """

    parameter: ClassVar[str] = "stops"

    @override
    def apply(self, image: Tensor, values: Mapping[str, Tensor]) -> Tensor:
        return with_gain(image, values[self.parameter])

    @override
    def of_stops(self, stops: Tensor) -> Tensor:
        return stops

    @override
    def in_stops(self, values: Tensor) -> Tensor:
        return values

    @override
    def beside(self, values: Tensor, stops: Tensor) -> Tensor:
        return values + stops

    @override
    def neutral(self) -> Tensor:
        return torch.zeros(())


class ChannelGain(ExposurePerPhoto):
    """Like `gain`, but with separate stops for red, green and blue, to model white balance."""

    parameter: ClassVar[str] = "stops"

    @override
    def apply(self, image: Tensor, values: Mapping[str, Tensor]) -> Tensor:
        return with_gain(image, values[self.parameter])

    @override
    def of_stops(self, stops: Tensor) -> Tensor:
        return stops[..., None].expand(*stops.shape, 3)

    @override
    def in_stops(self, values: Tensor) -> Tensor:
        return values

    @override
    def beside(self, values: Tensor, stops: Tensor) -> Tensor:
        return values + stops[:, None]

    @override
    def neutral(self) -> Tensor:
        return torch.zeros(3)

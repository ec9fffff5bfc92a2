"""An affine map of colours per photo."""

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor
from typing_extensions import override

from crossgrad_plugins.exposures.light import mapped
from crossgrad_plugins.exposures.per_photo import ExposurePerPhoto
from crossgrad_plugins.exposures.srgb import EXPONENT, OFFSET, STRETCH

#: An inverse with larger elements belongs to a map that removes a colour almost completely. Such a
#: map cannot be inverted; it occurs only in damaged files or with very high learning rates.
_LARGEST_INVERSE = 1e3
#: Lower bound of the scale of a map, 48 stops below white; it also applies to a map that turns
#: white into black.
_DARKEST = 2.0**-20


class Affine(ExposurePerPhoto):
    """Each photo shows A x + b for the sRGB value x of the render; the mean of all maps is neutral.

    The map has twelve numbers per photo, so it can also model effects other than exposure. It is
    suitable for many photos with much overlap.

    Source: the exposure compensation of 3D Gaussian Splatting (2024).
    """

    parameter: ClassVar[str] = "matrix"

    @override
    def apply(self, image: Tensor, values: Mapping[str, Tensor]) -> Tensor:
        return mapped(image, values[self.parameter])

    @override
    def of_stops(self, stops: Tensor) -> Tensor:
        # For all values except dark ones, a gain in linear light equals the map x -> scale (x +
        # OFFSET) - OFFSET.
        scale = torch.exp2(stops / EXPONENT)[..., None, None]
        ones = torch.ones(3, 1, dtype=stops.dtype, device=stops.device)
        diagonal = torch.eye(3, dtype=stops.dtype, device=stops.device)
        return torch.cat([scale * diagonal, (scale - 1.0) * OFFSET * ones], dim=-1)

    @override
    def in_stops(self, values: Tensor) -> Tensor:
        white = values.sum(dim=-1) + OFFSET
        return EXPONENT * (white / STRETCH).clamp(min=_DARKEST).log2()

    @override
    def shift(self, name: str, values: Tensor, start: Tensor, end: Tensor) -> Tensor:
        # Do not add the difference of the two maps, because a sum would change the relative
        # exposure of photos and could make dark values negative. Instead, the new map applies
        # `end`, then the inverse of `start`, and then the map of the photo.
        inverse, failed = torch.linalg.inv_ex(start[:, :3])
        if failed or not inverse.abs().max() < _LARGEST_INVERSE:
            return super().shift(name, values, start, end)
        linear = values[..., :3] @ inverse
        constant = values[..., 3:] + linear @ (end[:, 3:] - start[:, 3:])
        return torch.cat([linear @ end[:, :3], constant], dim=-1)

    @override
    def beside(self, values: Tensor, stops: Tensor) -> Tensor:
        inner = self.of_stops(stops)
        linear = values[..., :3] @ inner[..., :3]
        constant = values[..., :3] @ inner[..., 3:] + values[..., 3:]
        return torch.cat([linear, constant], dim=-1)

    @override
    def neutral(self) -> Tensor:
        return torch.eye(3, 4)

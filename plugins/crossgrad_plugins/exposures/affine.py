"""An affine map of colours per photo."""

from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor
from typing_extensions import override

from crossgrad_plugins.exposures.light import mapped
from crossgrad_plugins.exposures.per_photo import ExposurePerPhoto
from crossgrad_plugins.exposures.srgb import EXPONENT, OFFSET, STRETCH

#: An inverse with larger elements belongs to a map that (nearly) removes a colour and cannot be
#: undone. Only values from files and very high learning rates lead to such maps.
_LARGEST_INVERSE = 1e3
#: A map that turns white into black counts as this scale: 48 stops.
_DARKEST = 2.0**-20


class Affine(ExposurePerPhoto):
    """Each photo shows A x + b for the render's sRGB value x; the mean of all maps is the identity.

    The twelve numbers per photo can also model effects other than exposure. Twelve numbers are
    suitable for many photos with much overlap.

    Source: the exposure compensation of 3D Gaussian Splatting (2024).
    """

    parameter: ClassVar[str] = "matrix"

    @override
    def apply(self, image: Tensor, values: Mapping[str, Tensor]) -> Tensor:
        return mapped(image, values[self.parameter])

    @override
    def of_stops(self, stops: Tensor) -> Tensor:
        # For all values except dark ones, a gain in linear light equals this map: s (x + o) - o.
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
        # Do not add the difference of the maps: this would change the relative exposure of the
        # photos and could make dark values negative. The new map applies `end` first, then the
        # inverse of `start`, and then the map of the photo.
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

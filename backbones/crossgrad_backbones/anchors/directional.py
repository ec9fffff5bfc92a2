"""Colours that depend on the direction, as spherical harmonics up to degree 1 (least squares)."""

from dataclasses import dataclass
from math import pi, sqrt

import torch
from torch import Tensor

from crossgrad_core.numerics.spherical import SH_C0

#: Band 1 of the real spherical harmonics: sqrt(3 / (4 pi)).
_SH_C1 = sqrt(3.0 / (4.0 * pi))
#: Weight of the squared coefficients of band 1, as a share of what directions all around would
#: give them. From one direction, or the same one again, band 1 then stays 0.
RIDGE = 0.01
_BASIS = 4


@dataclass(frozen=True, eq=False)
class ColorFit:
    """Normal equations of the fit for P anchors of k slots.

    Attributes:
        products: [P, k, 4, 4] weighted sums of basis times basis.
        colors: [P, k, 4, 3] weighted sums of basis times colour, less 1/2.
    """

    products: Tensor
    colors: Tensor

    @classmethod
    def zeros(cls, like: Tensor) -> "ColorFit":
        """For tensors [P, k, ...]."""
        shape = (*like.shape[:2], _BASIS)
        return cls(like.new_zeros(*shape, _BASIS), like.new_zeros(*shape, 3))

    def add(self, rows: Tensor, weights: Tensor, directions: Tensor, colors: Tensor) -> None:
        """Adds the colours of anchors `rows` [A] as seen along the given directions.

        Args:
            rows: [A] int64, each once.
            weights: [A, k].
            directions: [A, k, 3] unit vectors from the camera.
            colors: [A, k, 3] RGB.
        """
        x, y, z = directions.unbind(-1)
        ones = torch.full_like(x, SH_C0)
        basis = torch.stack([ones, -_SH_C1 * y, _SH_C1 * z, -_SH_C1 * x], -1)
        weighted = weights[..., None, None] * basis[..., None]
        self.products[rows] += weighted * basis[..., None, :]
        self.colors[rows] += weighted * (colors[..., None, :] - 0.5)

    def solved(self, anchor: Tensor, slot: Tensor) -> Tensor:
        """[G, 4, 3] coefficients of the given slots, whose weights must not all be 0."""
        products = self.products[anchor, slot]
        total = products[:, 0, 0] / SH_C0**2
        ridge = torch.diag(products.new_tensor([0.0, 1.0, 1.0, 1.0]))
        full = products + (RIDGE * _SH_C1**2 / 3.0) * total[:, None, None] * ridge
        solution: Tensor = torch.linalg.solve(full, self.colors[anchor, slot])
        return solution

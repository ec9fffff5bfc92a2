"""Real spherical harmonics up to degree 3, and their rotation."""

from functools import cache
from math import pi, sqrt
from typing import Final

import torch
from torch import Tensor

#: Number of directions in which the spherical harmonics of a rotated frame are compared. It is more
#: than twice the number of harmonics.
_DIRECTIONS: Final = 48


def harmonics(directions: Tensor, degree: int) -> Tensor:
    """Return [N, (degree + 1)^2] basis functions at unit vectors [N, 3].

    Order and signs are as in 3DGS PLY files: for each band l the orders m = -l..l, with the
    Condon-Shortley phase.
    """
    x, y, z = directions.unbind(-1)
    bands = [torch.full_like(x, sqrt(1 / (4 * pi)))]
    if degree >= 1:
        c = sqrt(3 / (4 * pi))
        bands += [-c * y, c * z, -c * x]
    if degree >= 2:  # noqa: PLR2004
        c = sqrt(15 / (4 * pi))
        zonal = sqrt(5 / (16 * pi)) * (2 * z * z - x * x - y * y)
        bands += [c * x * y, -c * y * z, zonal, -c * x * z, c / 2 * (x * x - y * y)]
    if degree >= 3:  # noqa: PLR2004
        c1, c2, c3 = sqrt(21 / (32 * pi)), sqrt(105 / (4 * pi)), sqrt(35 / (32 * pi))
        bands += [
            -c3 * y * (3 * x * x - y * y),
            c2 * x * y * z,
            -c1 * y * (4 * z * z - x * x - y * y),
            sqrt(7 / (16 * pi)) * z * (2 * z * z - 3 * x * x - 3 * y * y),
            -c1 * x * (4 * z * z - x * x - y * y),
            c2 / 2 * z * (x * x - y * y),
            -c3 * x * (x * x - 3 * y * y),
        ]
    return torch.stack(bands, -1)


def harmonics_rotation(rotation: Tensor, degree: int) -> Tensor:
    """Return the matrix [B, B], float64, that rotates coefficients of bands 1 to `degree`.

    The harmonics of a rotated direction are linear in the harmonics of the direction, with an
    orthogonal matrix for each band. The matrix is fitted to the values of the harmonics in enough
    directions.
    """
    directions = _directions()
    before, after = (
        harmonics(vectors, degree)[:, 1:] for vectors in (directions, directions @ rotation)
    )
    matrix: Tensor = torch.linalg.lstsq(before, after).solution
    return matrix


@cache
def _directions() -> Tensor:
    """Return unit vectors [48, 3], float64, in all directions."""
    drawn = torch.randn((_DIRECTIONS, 3), generator=torch.Generator().manual_seed(0)).double()
    unit: Tensor = drawn / drawn.norm(dim=1, keepdim=True)
    return unit

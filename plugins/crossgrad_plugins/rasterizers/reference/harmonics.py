"""Colour from real spherical harmonics up to degree 3."""

from math import pi, sqrt

import torch
from torch import Tensor

from crossgrad_core.plugin import Gaussians


def view_colors(gaussians: Gaussians, center: Tensor) -> Tensor:
    """Return [N, 3] RGB as seen from the position `center` [3].

    RGB colours are returned unchanged. Spherical harmonics (SH) are evaluated as max(0, 0.5 + sum
    of bands). Bands above the active degree are left out. A value that is clamped to 0 has no
    gradient.
    """
    if gaussians.colors is not None:
        return gaussians.colors
    coefficients = coefficients_of(gaussians)
    if coefficients is None:
        raise ValueError("Gaussians need `colors` or `sh_dc`; found neither")
    offsets = gaussians.means - center
    basis = harmonics(offsets / offsets.norm(dim=-1, keepdim=True), gaussians.sh_degree)
    return (0.5 + (basis[:, :, None] * coefficients).sum(1)).clamp(min=0.0)


def coefficients_of(gaussians: Gaussians) -> Tensor | None:
    """Return [N, (degree + 1)^2, 3] coefficients up to the active degree; None without SH."""
    if gaussians.sh_dc is None or gaussians.sh_rest is None:
        return gaussians.sh_dc
    active = gaussians.sh_rest[:, : (gaussians.sh_degree + 1) ** 2 - 1]
    return torch.cat([gaussians.sh_dc, active], 1)


def harmonics(directions: Tensor, degree: int) -> Tensor:
    """Return [N, (degree + 1)^2] basis functions at unit vectors [N, 3].

    Order and signs are those of 3DGS PLY files: orders m = -l..l of each band l, with the
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

"""Colour from real spherical harmonics up to degree 3."""

import torch
from torch import Tensor

from crossgrad_core.numerics.harmonics import harmonics
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

"""Sharing one Gaussian among n copies at one place so that the picture stays the same.

Source: Kheradmand et al. 2024, 3D Gaussian Splatting as Markov Chain Monte Carlo, eq. 9.
"""

from dataclasses import dataclass
from math import pi, sqrt

import torch
from torch import Tensor

#: More copies than these count as so many (the published bound).
MOST_COPIES = 51
#: Step of the quadrature, in standard deviations. The integrand is entire, so the trapezoidal rule
#: errs by a factor exp(-c / step): for 51 opaque copies 2e-12 at 0.2, less than rounding at 0.15.
_STEP = 0.15
#: Number of steps: at 9.6 standard deviations 51 copies are below 1e-18.
_STEPS = 64


def shared_opacity(opacity: Tensor, copies: Tensor) -> Tensor:
    """Opacity of each of n copies that together are as opaque as one: 1 - (1 - o)^(1/n).

    Args:
        opacity: [R] float64 in [0, 1].
        copies: [R] n >= 1.
    """
    return -torch.expm1(torch.log1p(-opacity) / copies)


def shared_scale(opacity: Tensor, copies: Tensor) -> Tensor:
    """Factor of the scales of each of n copies, so that they together are as wide as one.

    With o' the shared opacity the published factor is o / D with the alternating sums
    D = sum_{i=1..n} sum_{q<i} C(i-1, q) (-1)^q o'^(q+1) / sqrt(q+1). They cancel to nothing for
    many opaque copies, but 1 / sqrt(q+1) is the integral of a Gaussian to the power q+1, and under
    the integral the sums close:

        D = 1/sqrt(2 pi) int 1 - (1 - o' exp(-x^2/2))^n dx,

    a positive, smooth integrand. The trapezoidal rule sums it to rounding.

    Args:
        opacity: [R] float64 in [0, 1], before it is shared.
        copies: [R] 1 <= n <= 51.

    Returns:
        [R] in (0, 1]; 1, the limit, where the opacity is 0 or below the smallest normal number.
    """
    nodes = _STEP * torch.arange(_STEPS + 1, dtype=opacity.dtype, device=opacity.device)
    weights = torch.full_like(nodes, 2.0 * _STEP / sqrt(2.0 * pi))
    weights[0] /= 2.0
    each = shared_opacity(opacity, copies)[:, None] * torch.exp(-nodes * nodes / 2.0)
    covered = -torch.expm1(copies[:, None] * torch.log1p(-each))
    some = opacity > torch.finfo(opacity.dtype).tiny
    return torch.where(some, opacity / (covered @ weights), torch.ones_like(opacity))


@dataclass(frozen=True)
class Pool:
    """Primitives of which some are copies of others.

    Attributes:
        source: [M] int64, the old primitive of each.
        opacity: [M] float64.
        scale: [M] float64, factor of its scales.
        touched: [M] bool, whether it shares its source with others.
    """

    source: Tensor
    opacity: Tensor
    scale: Tensor
    touched: Tensor

    @classmethod
    def of(cls, opacity: Tensor) -> "Pool":
        """The primitives as they are, of these opacities [M] (float64)."""
        source = torch.arange(opacity.shape[0], device=opacity.device)
        untouched = torch.zeros_like(source, dtype=torch.bool)
        return cls(source, opacity, torch.ones_like(opacity), untouched)

    def copied(self, index: Tensor, lowest: float) -> "Pool":
        """The primitives at `index` [M']; those that occur more than once share.

        Args:
            index: [M'] int64.
            lowest: A shared opacity is not below this, and below 1 by a float32 rounding.
        """
        copies = torch.bincount(index, minlength=self.source.shape[0]).clamp(max=MOST_COPIES)
        rows = (copies > 1).nonzero().squeeze(1)
        opacity, scale, touched = self.opacity.clone(), self.scale.clone(), self.touched.clone()
        highest = 1.0 - torch.finfo(torch.float32).eps
        opacity[rows] = shared_opacity(self.opacity[rows], copies[rows]).clamp(lowest, highest)
        scale[rows] *= shared_scale(self.opacity[rows], copies[rows])
        touched[rows] = True
        return Pool(self.source[index], opacity[index], scale[index], touched[index])

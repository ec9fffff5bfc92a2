"""Noise of the positions: Langevin exploration for Gaussians that are nearly transparent."""

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from crossgrad_core.numerics.elementwise import sigmoid

#: Steepness of the gate and the opacity at which it is half open (3DGS-MCMC).
GATE_STEEPNESS = 100.0
GATE_OPACITY = 0.005
#: Shifts below this share of a Gaussian's own size are left out: float32 knows no finer places.
NEGLIGIBLE = 1e-7


def position_noise(
    parameters: Mapping[str, Tensor], strength: float, rng: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """The rows of `means` that noise moves, and by how much.

    shift = Sigma n sig(-100 (o - 0.005)) strength, with n three standard normal numbers. No number
    is drawn for a Gaussian that would move by less than 1e-7 of its largest scale: every opaque
    one, so that the noise costs little once training is under way.

    Args:
        parameters: With `scales` (log) [N, 3], `quats` [N, 4] and `opacities` (logit) [N].
        strength: Learning rate of the positions times the noise's own factor, 1 / local units.
        rng: The generator.

    Returns:
        Rows [R] int64 and shifts [R, 3], local units.

    Source: Kheradmand et al. 2024 (3DGS-MCMC), eq. 8.
    """
    log_scales = parameters["scales"].detach()
    opacity = sigmoid(parameters["opacities"].detach())
    factor = strength * sigmoid(GATE_STEEPNESS * (GATE_OPACITY - opacity))
    # Column by column: reducing rows of three is much slower on the CPU.
    a, b, c = log_scales.unbind(1)
    largest = torch.exp(torch.maximum(torch.maximum(a, b), c))
    rows = (factor * largest > NEGLIGIBLE).nonzero().squeeze(1)
    draws = rng.standard_normal((rows.shape[0], 3), dtype=np.float32)
    noise = torch.from_numpy(draws).to(log_scales, non_blocking=True)
    axes = torch.nn.functional.normalize(parameters["quats"].detach()[rows], dim=-1)
    variances = torch.exp(2.0 * log_scales[rows])
    shifts = rotated(variances * rotated(noise, axes, back=True), axes)
    return rows, shifts * factor[rows, None]


def rotated(vectors: Tensor, quats: Tensor, *, back: bool = False) -> Tensor:
    """Vectors [R, 3] turned by unit quaternions wxyz [R, 4], or back: v + w t + u x t, t = 2 u x v.

    No matrices are formed.
    """
    w, u = quats[:, :1], quats[:, 1:]
    turned: Tensor = 2.0 * torch.linalg.cross(u, vectors)
    along: Tensor = vectors + torch.linalg.cross(u, turned)
    return along - w * turned if back else along + w * turned

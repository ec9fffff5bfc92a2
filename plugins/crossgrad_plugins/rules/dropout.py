"""Dropout of random Gaussians in training views, so that a run does not overfit few photos.

Source: DropGaussian (Park et al. 2025), in which the share of omitted Gaussians grows with the
steps. The constant share and the choice of scenes were developed for crossgrad
(docs/few-photos.md).
"""

from dataclasses import replace
from typing import Final

import numpy as np
import torch
from torch import Tensor

from crossgrad_core.plugin import Field, GaussiansContext, GaussiansResult, Rule, hookimpl

#: Name of the rule and of its random generator.
NAME: Final = "dropout"


class Dropout(Rule):
    """Renders each training view without a share of the Gaussians."""

    share: float = Field(
        0.3, gt=0, le=0.9, description="share of the Gaussians that each training view leaves out"
    )

    @hookimpl
    def crossgrad_view_gaussians(self, context: GaussiansContext) -> GaussiansResult:
        """Raise the opacity of the remaining Gaussians to compensate for the omitted Gaussians."""
        gaussians = context.gaussians
        draws = _draws(context.rngs[NAME], len(gaussians), gaussians.opacities.device)
        raised = gaussians.opacities * ((draws >= self.share) / (1.0 - self.share))
        # Clamp the value to 1 but keep its gradient. Without the gradient, a nearly opaque Gaussian
        # could never fade.
        opacities = raised - (raised.detach() - 1.0).clamp(min=0.0)
        return GaussiansResult(replace(gaussians, opacities=opacities))


def _draws(rng: np.random.Generator, count: int, device: torch.device) -> Tensor:
    """Return [N] uniform numbers in [0, 1), drawn on the device, because CPU draws are slow."""
    if device.type == "cpu":
        return torch.from_numpy(rng.random(count, dtype=np.float32))
    generator = torch.Generator(device).manual_seed(int(rng.integers(1 << 63)))
    return torch.rand(count, generator=generator, device=device)

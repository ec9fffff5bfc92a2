"""Gaussians left out of training views at random, so that a run does not overfit few photos.

Source: DropGaussian (Park et al. 2025), whose share grows with the steps. A constant share, and the
scenes that it is used on, are ours (docs/few-photos.md).
"""

from dataclasses import replace
from typing import Final

import numpy as np
import torch
from torch import Tensor

from crossgrad_core.plugin import Field, GaussiansContext, GaussiansResult, Rule, hookimpl

#: The name of the rule, and of its generator.
NAME: Final = "dropout"


class Dropout(Rule):
    """Renders each training view without a share of the Gaussians."""

    share: float = Field(
        0.3, gt=0, le=0.9, description="share of the Gaussians that each training view leaves out"
    )

    @hookimpl
    def crossgrad_view_gaussians(self, context: GaussiansContext) -> GaussiansResult:
        """Make the Gaussians that are left as much more opaque as others are missing."""
        gaussians = context.gaussians
        draws = _draws(context.rngs[NAME], len(gaussians), gaussians.opacities.device)
        raised = gaussians.opacities * ((draws >= self.share) / (1.0 - self.share))
        # Cut off at 1, but not its gradient: a nearly opaque Gaussian could never fade.
        opacities = raised - (raised.detach() - 1.0).clamp(min=0.0)
        return GaussiansResult(replace(gaussians, opacities=opacities))


def _draws(rng: np.random.Generator, count: int, device: torch.device) -> Tensor:
    """[N] uniform in [0, 1), drawn on the device: the CPU takes milliseconds for a million."""
    if device.type == "cpu":
        return torch.from_numpy(rng.random(count, dtype=np.float32))
    generator = torch.Generator(device).manual_seed(int(rng.integers(1 << 63)))
    return torch.rand(count, generator=generator, device=device)

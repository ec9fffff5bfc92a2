"""Dropout: training views are rendered without some random Gaussians to avoid overfitting.

Source: DropGaussian (Park et al. 2025), where the share of omitted Gaussians grows with the steps.
Crossgrad uses a constant share, and decides by the scene whether dropout is used
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
    """Renders each training view without a random share of the Gaussians."""

    share: float = Field(
        0.3, gt=0, le=0.9, description="share of the Gaussians that each training view leaves out"
    )

    @hookimpl
    def crossgrad_view_gaussians(self, context: GaussiansContext) -> GaussiansResult:
        """Return opacities for a training view: some are 0, and the others are raised."""
        gaussians = context.gaussians
        draws = _draws(context.rngs[NAME], len(gaussians), gaussians.opacities.device)
        raised = gaussians.opacities * ((draws >= self.share) / (1.0 - self.share))
        # Clamp the opacity to 1 but keep its gradient. Without the gradient, the opacity of a
        # nearly opaque Gaussian could never decrease.
        opacities = raised - (raised.detach() - 1.0).clamp(min=0.0)
        return GaussiansResult(replace(gaussians, opacities=opacities))


def _draws(rng: np.random.Generator, count: int, device: torch.device) -> Tensor:
    """Return [N] uniform numbers in [0, 1), drawn on the device of the Gaussians."""
    if device.type == "cpu":
        return torch.from_numpy(rng.random(count, dtype=np.float32))
    generator = torch.Generator(device).manual_seed(int(rng.integers(1 << 63)))
    return torch.rand(count, generator=generator, device=device)

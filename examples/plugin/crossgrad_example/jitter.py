"""A rule that moves the Gaussians slightly in training views."""

from dataclasses import replace

import torch

from crossgrad_core.plugin import Field, GaussiansContext, GaussiansResult, Rule, hookimpl


class Jitter(Rule):
    """A rule that moves the Gaussians of each training view at random, which smooths the result."""

    size: float = Field(1e-3, gt=0, description="standard deviation, in scene extents")

    @hookimpl
    def crossgrad_view_gaussians(self, context: GaussiansContext) -> GaussiansResult:
        """Add noise to the positions; the generator is part of the checkpoint."""
        means = context.gaussians.means
        noise = context.rngs["jitter"].standard_normal(tuple(means.shape))
        moved = means + self.size * torch.from_numpy(noise).to(means)
        return GaussiansResult(replace(context.gaussians, means=moved))

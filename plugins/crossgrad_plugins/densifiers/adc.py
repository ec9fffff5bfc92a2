"""Adaptive density control of 3DGS: clone, split, prune, opacity reset (Kerbl et al. 2023)."""

import torch
from pydantic import Field
from torch import Tensor
from typing_extensions import override

from crossgrad_core.plugin import DensifyContext, PluginState, screen_statistics
from crossgrad_plugins.densifiers.clone_split import AxisSplit, Growth


class AdaptiveDensityControl(AxisSplit):
    """Clones small and splits large Gaussians with a large gradient; prunes faint Gaussians.

    The gradient of a Gaussian is averaged over the renders in which the Gaussian was visible. The
    averaged value is the norm of the loss gradient with respect to the projected mean in NDC units
    (pixel gradient times W/2, H/2). Each view contributes the gradient of the view's own loss.
    """

    grad_threshold: float = Field(
        2e-4, gt=0, description="mean NDC gradient norm above which Gaussians are densified"
    )

    @override
    def observed(self, context: DensifyContext, state: PluginState) -> PluginState:
        totals = screen_statistics.sums(context, state, ("gradient", "renders"))
        for record in context.views:
            rows = screen_statistics.seen(record)
            norms = torch.linalg.vector_norm(screen_statistics.ndc_gradient(record, rows), dim=1)
            drawn = screen_statistics.visible(record, rows)
            screen_statistics.add(record, totals["gradient"], norms * drawn, rows)
            screen_statistics.add(record, totals["renders"], drawn, rows)
        return PluginState(per_primitive=totals)

    @override
    def growth(self, context: DensifyContext, state: PluginState, small: Tensor) -> Growth:
        gradient = screen_statistics.mean(state.per_primitive, "gradient", "renders")
        grows = gradient >= self.grad_threshold
        return Growth(clone=grows & small, split=grows & ~small, strength=gradient)

"""Density control of Pixel-GS (Zhang et al. 2024, arXiv 2403.15530)."""

import torch
from pydantic import Field
from torch import Tensor
from typing_extensions import override

from crossgrad_core.plugin import DensifyContext, PluginState, ViewRecord, screen_statistics
from crossgrad_plugins.densifiers.clone_split import AxisSplit, Growth


class PixelDensityControl(AxisSplit):
    """Adaptive density control whose gradients are weighted by pixels and scaled by depth.

    A render in which a Gaussian covers many pixels gets a large weight. The statistic is sum(m f
    |g|) / sum(m). m is the number of pixels in which the Gaussian was blended, and g the NDC
    gradient of its projected mean. f = min(1, (z / depth_threshold)^2) with the depth z of the
    centre reduces the growth of floaters in front of a camera. Only this statistic is scaled; the
    gradients for training are unchanged. Source: Pixel-GS.
    """

    needs = frozenset({"pixels"})

    grad_threshold: float = Field(
        2e-4, gt=0, description="scaled NDC gradient above which Gaussians are densified"
    )
    depth_threshold: float = Field(
        0.37,
        gt=0,
        description="distance to a camera below which Gaussians receive a lower weight; scene "
        "extents",
    )

    @override
    def observed(self, context: DensifyContext, state: PluginState) -> PluginState:
        totals = screen_statistics.sums(context, state, ("gradient", "pixels"))
        for record in context.views:
            weights = screen_statistics.pixels(record)
            norms = torch.linalg.vector_norm(screen_statistics.ndc_gradient(record), dim=1)
            screen_statistics.add(
                record, totals["gradient"], weights * self._nearness(record) * norms
            )
            screen_statistics.add(record, totals["pixels"], weights)
        return PluginState(per_primitive=totals)

    def _nearness(self, record: ViewRecord) -> Tensor:
        """Return [N] the factor f of each Gaussian in this view, in [0, 1]."""
        means = record.gaussians.means
        pose = record.view.camera.world_to_camera.to(means, non_blocking=True)
        x, y, z = means.unbind(1)
        # Do not use a matrix product, because its rounding depends on the number of threads.
        depths = x * pose[2, 0] + y * pose[2, 1] + z * pose[2, 2] + pose[2, 3]
        # The unit of the local frame is the extent of the training cameras, so no conversion is
        # needed.
        return (depths / self.depth_threshold).square().clamp(max=1.0)

    @override
    def growth(self, context: DensifyContext, state: PluginState, small: Tensor) -> Growth:
        gradient = screen_statistics.mean(state.per_primitive, "gradient", "pixels")
        grows = gradient >= self.grad_threshold
        return Growth(clone=grows & small, split=grows & ~small, strength=gradient)

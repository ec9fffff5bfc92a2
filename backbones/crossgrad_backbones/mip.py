"""Mip-Splatting: a 3-D smoothing filter and a 2-D mip filter (Yu et al. 2024, arXiv 2311.16493)."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import sqrt
from typing import Any, ClassVar

import numpy as np
import torch
from pydantic import Field
from torch import Tensor
from typing_extensions import override

from crossgrad_backbones.baking import as_plain
from crossgrad_backbones.vanilla import Vanilla
from crossgrad_backbones.visibility import NEAR, finest_pixels
from crossgrad_core.numerics.elementwise import sigmoid
from crossgrad_core.plugin import (
    AfterStepContext,
    Block,
    Camera,
    DensifyResult,
    Edit,
    Gaussians,
    LearningRate,
    Parameters,
    Phase,
    Response,
    Rows,
    Scene,
    Schedule,
    hookimpl,
)

#: Variance of the 3-D filter in squared pixels. The pixel size is taken from the camera that has
#: the smallest pixels at the Gaussian.
VARIANCE = 0.2


@torch.no_grad()
def filter_widths(means: Tensor, cameras: Sequence[Camera], near: float, *, parity: bool) -> Tensor:
    """Return the standard deviation [N] of each Gaussian's 3-D filter, in local units.

    The standard deviation is sqrt(VARIANCE) times the smallest z / f over all cameras that see the
    mean, with depth z and focal length f. Gaussians that no camera sees get the largest value of
    all other Gaussians, or 0 if no Gaussian is seen.

    Args:
        means: [N, 3] means in local units.
        cameras: The training cameras.
        near: Depth of the near plane in local units.
        parity: True to divide the smallest depth by the longest focal length of all cameras, as in
            the published code. The camera with the longest focal length may not even see the
            Gaussian.
    """
    focal = max(camera.fx for camera in cameras) if parity else None
    finest = finest_pixels(means, cameras, near, focal)
    seen = finest.isfinite()
    largest = finest[seen].max() if bool(seen.any()) else finest.new_zeros(())
    return sqrt(VARIANCE) * torch.where(seen, finest, largest)


def kept_opacity(log_scales: Tensor, widths: Tensor) -> Tensor:
    """Return the factor [N] by which the filter reduces opacities.

    The factor is detached from autograd.
    """
    scales, filters = _finite_scales(log_scales.detach()), _per_axis(widths)
    return (scales / torch.hypot(scales, filters)).prod(1)


def smoothed(log_scales: Tensor, logits: Tensor, widths: Tensor) -> tuple[Tensor, Tensor]:
    """Return the filtered scales sqrt(s^2 + w^2) [N, 3] and the filtered opacities [N].

    The opacity factor sqrt(prod s^2 / prod (s^2 + w^2)) is computed from quotients, so that no
    intermediate result overflows or underflows. The backward pass is written by hand, because
    autograd would take twice as long.

    Args:
        log_scales: [N, 3] logarithms of the scales s.
        logits: [N] logits of the opacities.
        widths: [N] standard deviations w of the filter. The widths receive no gradient.
    """
    scales_and_opacities: tuple[Tensor, Tensor] = _Smoothed.apply(log_scales, logits, widths)  # type: ignore[no-untyped-call]
    return scales_and_opacities


class _Smoothed(torch.autograd.Function):
    """The 3-D filter with its backward pass.

    With S = hypot(s, w) and k = s / S, the derivatives are dS/d(log s) = S k^2 and d(log prod
    k)/d(log s) = (w / S)^2.
    """

    @staticmethod
    @override
    def forward(ctx: Any, log_scales: Tensor, logits: Tensor, widths: Tensor) -> Any:
        scales, filters = _finite_scales(log_scales), _per_axis(widths)
        smooth = torch.hypot(scales, filters)
        kept = scales.div_(smooth)
        opacities = sigmoid(logits)
        drawn = opacities * kept.prod(1)
        # Compute in place, because allocating memory takes longer than the arithmetic.
        shares = kept.square_(), filters.div_(smooth).square_()
        ctx.save_for_backward(smooth, *shares, opacities, drawn)
        return smooth, drawn

    @staticmethod
    @override
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        smooth, kept_share, lost_share, opacities, drawn = ctx.saved_tensors
        by_log_opacity = gradients[1] * drawn
        by_scales = (gradients[0] * smooth).mul_(kept_share)
        by_scales.addcmul_(by_log_opacity[:, None], lost_share)
        return by_scales, by_log_opacity * (1 - opacities), None


def _finite_scales(log_scales: Tensor) -> Tensor:
    """Return exp(log_scales), limited to the range of the floating-point type.

    With finite scales, every quotient of scales is defined.
    """
    limits = torch.finfo(log_scales.dtype)
    return log_scales.exp().clamp_(limits.tiny, limits.max)


def _per_axis(values: Tensor) -> Tensor:
    """Repeat each value three times, and return a contiguous array [N, 3].

    Operations on an expanded view are slower.
    """
    return values[:, None].expand(-1, 3).contiguous()


#: Dilation of the 2-D mip filter in px^2.
DILATION = 0.1


class MipSplatting(Vanilla):
    """The 3DGS representation with a 3-D filter.

    No Gaussian can be smaller than the photos resolve.

    Blocks: the blocks of `vanilla`, and `filter` [N]. The filter is the standard deviation of each
    Gaussian's 3-D filter. The filter is computed from the training cameras and not trained. Density
    control uses the scales and opacities before filtering. Source: Mip-Splatting (Yu et al. 2024).
    """

    response: ClassVar[Response] = "antialiased"
    plain: ClassVar[bool] = False
    sets_dilation: ClassVar[bool] = True
    passthrough: ClassVar[Mapping[str, str]] = Vanilla.passthrough
    axes: ClassVar[tuple[str, str] | tuple[()]] = Vanilla.axes

    near: float = Field(NEAR, gt=0, description="near plane of the filter, local units")
    parity: bool = Field(
        False, description="use the longest focal length for all cameras, as published"
    )

    @override
    def blocks(self) -> tuple[Block, ...]:
        frozen = LearningRate(0.0)
        return (*super().blocks(), Block("filter", ("filter",), True, "geometry", frozen))

    @override
    def create(self, scene: Scene, rng: np.random.Generator) -> Parameters:
        return self._filtered(super().create(scene, rng), scene)

    @override
    def adopt(self, gaussians: Gaussians, scene: Scene, rng: np.random.Generator) -> Parameters:
        return self._filtered(super().adopt(gaussians, scene, rng), scene)

    @override
    def prepare(self, parameters: Parameters, scene: Scene, phase: Phase) -> Parameters:
        return self._filtered(parameters, scene)

    def _filtered(self, parameters: Parameters, scene: Scene) -> Parameters:
        return {**parameters, "filter": self._widths(parameters, scene)}

    def _widths(self, parameters: Mapping[str, Tensor], scene: Scene) -> Tensor:
        cameras = [view.camera for view in scene.train_views]
        return filter_widths(parameters["means"], cameras, self.near, parity=self.parity)

    @hookimpl
    def crossgrad_after_step(self, context: AfterStepContext) -> DensifyResult | None:
        """Compute the filter again in the steps without an edit that `renews` chooses."""
        if context.edited or not renews(context.schedule, context.step):
            return None
        widths = self._widths(context.parameters, context.scene)
        return DensifyResult(Edit(values={"filter": Rows(widths)}))

    @override
    def splats(self, parameters: Mapping[str, Tensor], degree: int) -> Gaussians:
        scales, opacities = smoothed(
            parameters["scales"], parameters["opacities"], parameters["filter"]
        )
        return replace(
            super().splats(parameters, degree),
            scales=scales,
            opacities=opacities,
            response=self.response,
            dilation=DILATION,
        )

    @override
    def capped_opacities(self, parameters: Mapping[str, Tensor], cap: float) -> Tensor:
        """Limit the filtered opacity, and convert the limit to the opacity before filtering."""
        kept = kept_opacity(parameters["scales"], parameters["filter"])
        # If even a stored opacity of 1 stays below the limit, the logit is infinite, which means no
        # limit.
        limit = torch.logit((cap / kept).clamp(max=1.0))
        return torch.minimum(parameters["opacities"].detach(), limit)

    @override
    def unbaked(self, parameters: Mapping[str, Tensor], phase: Phase) -> Gaussians:
        return super().bake(parameters, phase, ())

    @override
    def bake(
        self, parameters: Mapping[str, Tensor], phase: Phase, cameras: Sequence[Camera]
    ) -> Gaussians:
        return as_plain(super().bake(parameters, phase, cameras), cameras, DILATION, self.near)


def renews(schedule: Schedule, step: int) -> bool:
    """Return True if the filter is computed again after a step without an edit.

    As published, the filter is computed again every 100 of 30,000 steps, from the end of density
    control until 100 steps before the end of the run.
    """
    every = max(1, schedule.lr_until // 300)
    last = schedule.counted(schedule.total) - every
    inside = schedule.lr_until // 2 < schedule.counted(step) <= last
    return inside and schedule.reaches(step, every)

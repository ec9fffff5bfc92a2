"""Mip-Splatting: a 3-D smoothing filter and a 2-D mip filter (Yu et al. 2024, arXiv 2311.16493)."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np
import torch
from pydantic import Field
from torch import Tensor
from typing_extensions import override

from crossgrad_backbones.baking import as_plain
from crossgrad_backbones.smoothing import filter_widths, kept_opacity, smoothed
from crossgrad_backbones.vanilla import Vanilla
from crossgrad_backbones.visibility import NEAR
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

#: Dilation of the 2-D mip filter, px^2.
DILATION = 0.1


class MipSplatting(Vanilla):
    """The 3DGS representation, widened so that no Gaussian is finer than the photos resolve.

    Blocks: those of vanilla, and `filter` [N], the standard deviation of each Gaussian's 3-D
    filter, which is derived from the training cameras and gets no gradient. Density control works
    on the raw scales and opacities. Source: Mip-Splatting, methods of section 4.
    """

    response: ClassVar[Response] = "antialiased"
    plain: ClassVar[bool] = False
    sets_dilation: ClassVar[bool] = True
    passthrough: ClassVar[Mapping[str, str]] = Vanilla.passthrough
    axes: ClassVar[tuple[str, str] | tuple[()]] = Vanilla.axes

    near: float = Field(NEAR, gt=0, description="near plane of the filter, local units")
    parity: bool = Field(
        False, description="one focal length, the longest, for all cameras, as published"
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
        """Renews the filter while nothing else does."""
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
        """The filtered opacity is capped and what the filter takes divided out again."""
        kept = kept_opacity(parameters["scales"], parameters["filter"])
        # Where even an opacity of 1 stays below the cap the logit is infinite: no limit.
        limit = torch.logit((cap / kept).clamp(max=1.0))
        return torch.minimum(parameters["opacities"].detach(), limit)

    @override
    def bake(
        self, parameters: Mapping[str, Tensor], phase: Phase, cameras: Sequence[Camera]
    ) -> Gaussians:
        return as_plain(super().bake(parameters, phase, cameras), cameras, DILATION, self.near)


def renews(schedule: Schedule, step: int) -> bool:
    """Whether the filter is renewed after a step without an edit.

    As published: every 100 of 30,000 steps once density control is over, until 100 before the end.
    """
    every = max(1, schedule.lr_until // 300)
    last = schedule.counted(schedule.total) - every
    inside = schedule.lr_until // 2 < schedule.counted(step) <= last
    return inside and schedule.reaches(step, every)

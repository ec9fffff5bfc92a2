"""Analytic-Splatting: Gaussians integrated over pixels (Liang et al. 2024, arXiv 2403.11056)."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import ClassVar

from torch import Tensor
from typing_extensions import override

from crossgrad_backbones.baking import as_plain
from crossgrad_backbones.vanilla import Vanilla
from crossgrad_backbones.visibility import NEAR
from crossgrad_core.plugin import Camera, Gaussians, Phase, Response

#: Variance of a box of one pixel, in px^2. Integrating a Gaussian over a pixel adds this variance
#: to the variance of the Gaussian.
PIXEL_VARIANCE = 1.0 / 12.0


class AnalyticSplatting(Vanilla):
    """The 3DGS representation with the pixel response `analytic` and without dilation.

    Source: Liang et al. 2024. The optional filters of the paper are not implemented.
    """

    response: ClassVar[Response] = "analytic"
    plain: ClassVar[bool] = False
    sets_dilation: ClassVar[bool] = True
    passthrough: ClassVar[Mapping[str, str]] = Vanilla.passthrough
    axes: ClassVar[tuple[str, str] | tuple[()]] = Vanilla.axes

    @override
    def splats(self, parameters: Mapping[str, Tensor], degree: int) -> Gaussians:
        return replace(super().splats(parameters, degree), response=self.response, dilation=0.0)

    @override
    def bake(
        self, parameters: Mapping[str, Tensor], phase: Phase, cameras: Sequence[Camera]
    ) -> Gaussians:
        return as_plain(super().bake(parameters, phase, cameras), cameras, PIXEL_VARIANCE, NEAR)

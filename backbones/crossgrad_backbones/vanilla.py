"""Vanilla 3DGS: each primitive is an explicit Gaussian (Kerbl et al. 2023)."""

from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor
from typing_extensions import override

from crossgrad_backbones.neighbours import nearest_neighbour_scales
from crossgrad_core.numerics.elementwise import sigmoid
from crossgrad_core.numerics.raster_constants import COEFFICIENTS, SH_C0
from crossgrad_core.plugin import (
    Backbone,
    Block,
    Camera,
    Gaussians,
    LearningRate,
    Parameters,
    Phase,
    Scene,
    Selection,
)


class Vanilla(Backbone):
    """The 3DGS representation with the published learning rates.

    Blocks: means [N, 3]; scales [N, 3] (logarithms); quats [N, 4] (w, x, y, z); opacities [N]
    (logits); f_dc [N, 1, 3]; f_rest [N, 15, 3]. Source: 3DGS (Kerbl et al. 2023).
    """

    plain: ClassVar[bool] = True
    passthrough: ClassVar[Mapping[str, str]] = {"sh_dc": "f_dc", "sh_rest": "f_rest"}
    positions: ClassVar[str] = "means"
    axes: ClassVar[tuple[str, str] | tuple[()]] = ("scales", "quats")

    initial_opacity: float = Field(0.1, gt=0.0, lt=1.0, description="initial opacity of a Gaussian")
    sh_degree: int = Field(3, ge=0, le=3, description="highest spherical-harmonics degree")
    lr_means: float = Field(
        1.6e-4, gt=0, description="initial learning rate of the positions, per scene extent"
    )
    lr_means_final: float = Field(
        1.6e-6, gt=0, description="final learning rate of the positions, per scene extent"
    )
    lr_scales: float = Field(5e-3, ge=0, description="learning rate of the log scales")
    lr_quats: float = Field(1e-3, ge=0, description="learning rate of the rotations")
    lr_opacities: float = Field(0.05, ge=0, description="learning rate of the opacity logits")
    lr_f_dc: float = Field(2.5e-3, ge=0, description="learning rate of SH band 0")
    lr_f_rest: float = Field(2.5e-3 / 20, ge=0, description="learning rate of the higher SH bands")

    def unused_options(self, selection: Selection) -> Mapping[str, str]:
        """Return the options that have no effect (see `HasUnusedOptions`)."""
        if self.sh_degree > 0:
            return {}
        return {"lr_f_rest": "there are no higher SH bands (sh_degree = 0); leave the option out"}

    @override
    def blocks(self) -> tuple[Block, ...]:
        rows = (
            Block("means", ("means",), True, "geometry", self._means_lr()),
            Block("scales", ("scales",), True, "geometry", self._scales_lr()),
            Block("quats", ("quats",), True, "geometry", LearningRate(self.lr_quats)),
            Block("opacities", ("opacities",), True, "appearance", LearningRate(self.lr_opacities)),
            Block("f_dc", ("f_dc",), True, "appearance", LearningRate(self.lr_f_dc)),
        )
        if self.sh_degree == 0:
            return rows
        rate = LearningRate(self.lr_f_rest)
        rest = Block("f_rest", ("f_rest",), True, "appearance", rate, rests=True)
        return (*rows, rest)

    def _scales_lr(self) -> LearningRate:
        # The factor 2 for runs with few passes was measured for crossgrad (docs/schedules.md).
        return LearningRate(self.lr_scales, few_passes=2.0)

    def _means_lr(self) -> LearningRate:
        return LearningRate(self.lr_means, self.lr_means_final)

    @override
    def fitted_to(self, scene: Scene) -> tuple["Vanilla", tuple[str, ...]]:
        """Leave out spherical harmonics of high degree if the scene has too few training views.

        A Gaussian is seen from at most as many directions as there are training views. A higher
        degree can improve the result only if the scene has at least as many views as the degree has
        coefficients.
        """
        if "sh_degree" in self.model_fields_set:
            return self, ()
        views = len(scene.train)
        degree = max(d for d in range(4) if COEFFICIENTS[d] <= max(views, 1))
        if degree == self.sh_degree:
            return self, ()
        note = (
            f"spherical harmonics are limited to degree {degree}: {views} training views "
            f"give fewer directions than degree {degree + 1} has coefficients "
            f"({COEFFICIENTS[degree + 1]}); --set backbone.sh_degree=3 forces all bands"
        )
        return self.model_copy(update={"sh_degree": degree}), (note,)

    @override
    def create(self, scene: Scene, rng: np.random.Generator) -> Parameters:
        count = scene.points.shape[0]
        means = torch.from_numpy(scene.points).float()
        scales = torch.from_numpy(_sizes(scene)).float()
        quats = torch.zeros(count, 4)
        quats[:, 0] = 1.0
        rgb = torch.from_numpy(scene.point_colors).float() / 255.0
        tensors = {
            "means": means,
            "scales": scales.log()[:, None].repeat(1, 3),
            "quats": quats,
            "opacities": torch.from_numpy(self._first_opacities(scene)).float(),
            "f_dc": ((rgb - 0.5) / SH_C0)[:, None, :],
        }
        return self._with_rest(tensors, count)

    def _first_opacities(self, scene: Scene) -> NDArray[np.float64]:
        """Return the initial opacities [P] as logits."""
        opacities = np.full(len(scene.points), self.initial_opacity)
        if scene.point_opacities is not None:
            has_opacity = ~np.isnan(scene.point_opacities)
            opacities[has_opacity] = scene.point_opacities[has_opacity]
        return np.log(opacities / (1.0 - opacities))

    @override
    def adopt(self, gaussians: Gaussians, scene: Scene, rng: np.random.Generator) -> Parameters:
        if gaussians.sh_dc is None:
            raise ValueError(
                "only a backbone with spherical-harmonics Gaussians can start from Gaussians "
                "of a file"
            )
        opacities = gaussians.opacities.clamp(1e-6, 1.0 - 1e-6)
        tensors = {
            "means": gaussians.means.clone(),
            "scales": gaussians.scales.log(),
            "quats": gaussians.quats.clone(),
            "opacities": torch.logit(opacities),
            "f_dc": gaussians.sh_dc.clone(),
        }
        return self._with_rest(tensors, len(gaussians), gaussians.sh_rest)

    def _with_rest(
        self, tensors: Parameters, count: int, given: Tensor | None = None
    ) -> Parameters:
        if self.sh_degree > 0:
            rest = torch.zeros(count, COEFFICIENTS[self.sh_degree] - 1, 3)
            if given is not None:
                bands = min(rest.shape[1], given.shape[1])
                rest[:, :bands] = given[:, :bands]
            tensors["f_rest"] = rest
        return {name: tensor.requires_grad_() for name, tensor in tensors.items()}

    @override
    def decode(self, parameters: Mapping[str, Tensor], camera: Camera, phase: Phase) -> Gaussians:
        return self.splats(parameters, phase.schedule.sh_degree(phase.step, self.sh_degree))

    def splats(self, parameters: Mapping[str, Tensor], degree: int) -> Gaussians:
        """Return the Gaussians with spherical harmonics up to `degree`.

        The Gaussians are differentiable with respect to the parameters.
        """
        return Gaussians(
            means=parameters["means"],
            quats=parameters["quats"],
            scales=torch.exp(parameters["scales"]),
            opacities=sigmoid(parameters["opacities"]),
            sh_dc=parameters["f_dc"],
            sh_rest=parameters["f_rest"] if degree > 0 else None,
            sh_degree=degree,
        )

    @override
    def bake(
        self, parameters: Mapping[str, Tensor], phase: Phase, cameras: Sequence[Camera]
    ) -> Gaussians:
        return self.splats(parameters, self.sh_degree).detached()


def _sizes(scene: Scene) -> NDArray[np.float64]:
    """Return the initial standard deviations [P].

    Points with known sizes do not count as neighbours.
    """
    if scene.point_sizes is None:
        return nearest_neighbour_scales(scene.points)
    sizes = scene.point_sizes.copy()
    unknown = np.isnan(sizes)
    sizes[unknown] = nearest_neighbour_scales(scene.points[unknown])
    return sizes

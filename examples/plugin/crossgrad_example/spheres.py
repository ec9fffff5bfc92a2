"""Spheres: the smallest backbone."""

from collections.abc import Mapping, Sequence
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from crossgrad_core.numerics.raster_constants import SH_C0
from crossgrad_core.plugin import (
    Backbone,
    Block,
    Camera,
    Field,
    Gaussians,
    LearningRate,
    Parameters,
    Phase,
    Scene,
)

SPHERE = torch.tensor([1.0, 0.0, 0.0, 0.0])


class Spheres(Backbone):
    """Isotropic Gaussians with one colour each: 8 parameters per primitive."""

    default_densifier: ClassVar[str] = "none"
    plain: ClassVar[bool] = True

    size: float = Field(0.01, gt=0.0, description="initial, in scene extents")
    opacity: float = Field(0.1, gt=0.0, lt=1.0, description="initial")

    @override
    def blocks(self) -> tuple[Block, ...]:
        return (
            Block("means", ("means",), True, "geometry", LearningRate(1.6e-4, 1.6e-6)),
            Block("sizes", ("sizes",), True, "geometry", LearningRate(5e-3)),
            Block("opacities", ("opacities",), True, "appearance", LearningRate(0.05)),
            Block("rgb", ("rgb",), True, "appearance", LearningRate(2.5e-3)),
        )

    @override
    def create(self, scene: Scene, rng: np.random.Generator) -> Parameters:
        count = len(scene.points)
        tensors = {
            "means": torch.from_numpy(scene.points).float(),
            "sizes": torch.tensor(self.size).log().repeat(count),
            "opacities": torch.logit(torch.tensor(self.opacity)).repeat(count),
            "rgb": torch.from_numpy(scene.point_colors).float() / 255.0,
        }
        return {name: tensor.requires_grad_() for name, tensor in tensors.items()}

    @override
    def decode(self, parameters: Mapping[str, Tensor], camera: Camera, phase: Phase) -> Gaussians:
        means, sizes = parameters["means"], torch.exp(parameters["sizes"])
        return Gaussians(
            means=means,
            quats=SPHERE.to(means).expand(len(means), 4),
            scales=sizes[:, None].expand(-1, 3),
            opacities=torch.sigmoid(parameters["opacities"]),
            colors=parameters["rgb"],
        )

    @override
    def bake(
        self, parameters: Mapping[str, Tensor], phase: Phase, cameras: Sequence[Camera]
    ) -> Gaussians:
        drawn = self.decode(parameters, cameras[0], phase).detached()
        return Gaussians(
            means=drawn.means,
            quats=drawn.quats,
            scales=drawn.scales,
            opacities=drawn.opacities,
            sh_dc=((parameters["rgb"].detach() - 0.5) / SH_C0)[:, None, :],
        )

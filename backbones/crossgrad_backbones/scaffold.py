"""Scaffold-GS: neural Gaussians on a sparse grid of anchors (Lu et al. 2024)."""

from collections.abc import Mapping

import numpy as np
from pydantic import Field
from torch import Tensor
from typing_extensions import override

from crossgrad_backbones.anchors.base import AnchorBackbone, Used
from crossgrad_backbones.anchors.voxels import automatic_voxel_size, voxel_centers
from crossgrad_backbones.neighbours import nearest_neighbour_scales
from crossgrad_core.plugin import Camera, Parameters, Phase, Scene


class Scaffold(AnchorBackbone):
    """Anchors in all voxels that contain SfM points. A camera uses all anchors in its frustum."""

    voxel_size: float | None = Field(
        None,
        gt=0,
        description="edge of a voxel, extents; null: twice the median distance between points",
    )

    @override
    def create(self, scene: Scene, rng: np.random.Generator) -> Parameters:
        size = self.voxel_size or automatic_voxel_size(scene.points)
        positions = voxel_centers(scene.points, size)
        return self.created(positions, nearest_neighbour_scales(positions), size, scene, rng)

    @override
    def used(self, parameters: Mapping[str, Tensor], camera: Camera, phase: Phase) -> Used | None:
        return None

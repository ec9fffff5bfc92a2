"""What the backbones of anchors share: options, blocks, first values, decoding, regularisation."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor
from typing_extensions import override

from crossgrad_backbones.anchors import appearance
from crossgrad_backbones.anchors.activation import Seen
from crossgrad_backbones.anchors.baking import BAKED_CAMERAS, baked, evenly
from crossgrad_backbones.anchors.decode import decoded
from crossgrad_backbones.anchors.frustum import in_frustum
from crossgrad_backbones.anchors.heads import Heads
from crossgrad_backbones.anchors.volume import mean_volume
from crossgrad_core.backbone import Backbone
from crossgrad_core.blocks import Block, BlockKind, LearningRate, Parameters
from crossgrad_core.contexts import RegularizeContext, Regularized
from crossgrad_core.gaussians import Gaussians
from crossgrad_core.hooks import hookimpl
from crossgrad_core.rasterizer import ALPHA_THRESHOLD
from crossgrad_core.scene.types import Camera, Scene
from crossgrad_core.schedule import Phase
from crossgrad_core.splats import nearest_neighbour_scales

_FROZEN = LearningRate(0.0)


@dataclass(frozen=True)
class Used:
    """The anchors that a camera uses.

    Attributes:
        mask: [P] bool.
        factor: [P] in [0, 1], what multiplies their opacities; None: 1.
    """

    mask: Tensor
    factor: Tensor | None = None


class AnchorBackbone(Backbone):
    """Anchors with a feature each, which networks decode to k Gaussians per anchor and view.

    A backbone of this family says where its anchors start and which of them a camera uses.

    Blocks: anchors [P, 3] (frozen); offsets [P, k, 3] in units of exp(scales[:, :3]); features
    [P, F]; scales [P, 6] (log: stretch of the offsets, then size of the Gaussians); mlp_opacity,
    mlp_cov, mlp_color and where it is on mlp_bank (four tensors each); voxel_size (frozen). The
    rotation and the opacity of an anchor, which the published code holds but never trains, are left
    out. Source: Scaffold-GS (Lu et al. 2024); methods of section 2.
    """

    default_densifier: ClassVar[str] = "anchor"

    offsets: int = Field(10, ge=1, description="Gaussians per anchor")
    feature: int = Field(32, ge=1, description="width of the feature and of the hidden layers")
    opacity_distance: bool = Field(default=False, description="opacity depends on the distance")
    cov_distance: bool = Field(default=False, description="covariance depends on the distance")
    color_distance: bool = Field(default=False, description="colour depends on the distance")
    feature_bank: bool = Field(default=False, description="mix the feature at three strides")
    appearance: int = Field(0, ge=0, description="width of a code per training view; 0: none")
    volume_weight: float = Field(0.01, ge=0, description="weight of the mean volume, extents cubed")
    lr_offsets: float = Field(0.01, gt=0, description="initial, per scene extent")
    lr_offsets_final: float = Field(1e-4, gt=0, description="final, per scene extent")
    lr_features: float = Field(0.0075, ge=0, description="learning rate of the features")
    lr_scales: float = Field(0.007, ge=0, description="learning rate of the log scales")
    lr_opacity: float = Field(0.002, gt=0, description="initial, network of the opacity")
    lr_opacity_final: float = Field(2e-5, gt=0, description="final, network of the opacity")
    lr_cov: float = Field(0.004, ge=0, description="network of the covariance")
    lr_color: float = Field(0.008, gt=0, description="initial, network of the colour")
    lr_color_final: float = Field(5e-5, gt=0, description="final, network of the colour")
    lr_bank: float = Field(0.01, gt=0, description="initial, feature bank")
    lr_bank_final: float = Field(1e-5, gt=0, description="final, feature bank")
    lr_appearance: float = Field(0.05, gt=0, description="initial, appearance codes")
    lr_appearance_final: float = Field(5e-4, gt=0, description="final, appearance codes")

    @property
    def heads(self) -> Heads:
        """The networks."""
        far = (self.opacity_distance, self.cov_distance, self.color_distance)
        return Heads(self.offsets, self.feature, far, self.appearance, self.feature_bank)

    @override
    def blocks(self) -> tuple[Block, ...]:
        rates = {
            "mlp_opacity": LearningRate(self.lr_opacity, self.lr_opacity_final),
            "mlp_cov": LearningRate(self.lr_cov),
            "mlp_color": LearningRate(self.lr_color, self.lr_color_final),
            "mlp_bank": LearningRate(self.lr_bank, self.lr_bank_final),
        }
        kinds: dict[str, BlockKind] = {"mlp_cov": "geometry", "mlp_bank": "neutral"}
        offsets = LearningRate(self.lr_offsets, self.lr_offsets_final)
        return (
            Block("anchors", ("anchors",), True, "geometry", _FROZEN),
            Block("offsets", ("offsets",), True, "geometry", offsets),
            Block("features", ("features",), True, "neutral", LearningRate(self.lr_features)),
            Block("scales", ("scales",), True, "geometry", LearningRate(self.lr_scales)),
            *(n.block(kinds.get(n.name, "appearance"), rates[n.name]) for n in self.heads.networks),
            Block("voxel_size", ("voxel_size",), False, "geometry", _FROZEN),
            *self._appearance_blocks(),
        )

    def _appearance_blocks(self) -> tuple[Block, ...]:
        if not self.appearance:
            return ()
        rate = LearningRate(self.lr_appearance, self.lr_appearance_final)
        codes, poses = appearance.CODES, appearance.POSES
        return (
            Block(codes, (codes,), False, "appearance", rate),
            Block(poses, (poses,), False, "appearance", _FROZEN),
        )

    def created(
        self,
        positions: NDArray[np.float64],
        voxel_size: float,
        scene: Scene,
        rng: np.random.Generator,
    ) -> Parameters:
        """First values of all blocks of this class.

        Args:
            positions: [P, 3] of the anchors, local units.
            voxel_size: Edge of the finest voxel, local units.
            scene: The scene, for the appearance codes of its training views.
            rng: Draws the first values of the networks and codes.
        """
        count = positions.shape[0]
        scales = torch.from_numpy(np.log(nearest_neighbour_scales(positions))).float()
        tensors: Parameters = {
            "anchors": torch.from_numpy(positions).float(),
            "offsets": torch.zeros(count, self.offsets, 3),
            "features": torch.zeros(count, self.feature),
            "scales": scales[:, None].repeat(1, 6),
            "voxel_size": torch.tensor(voxel_size, dtype=torch.float64),
        }
        for network in self.heads.networks:
            tensors |= network.created(rng)
        if self.appearance:
            codes = rng.standard_normal((len(scene.train), self.appearance)).astype(np.float32)
            tensors |= appearance.created_codes(scene, torch.from_numpy(codes))
        trained = {name for block in self.trained_blocks() for name in block.tensors}
        return {name: tensor.requires_grad_(name in trained) for name, tensor in tensors.items()}

    @override
    def adopt(self, gaussians: Gaussians, scene: Scene, rng: np.random.Generator) -> Parameters:
        """Anchors where the Gaussians are; of these only the means are taken over."""
        drawn = gaussians.opacities >= ALPHA_THRESHOLD
        points = gaussians.means[drawn].double().numpy()
        colors = np.full(points.shape, 127, dtype=np.uint8)
        return self.create(replace(scene, points=points, point_colors=colors), rng)

    @abstractmethod
    def used(self, parameters: Mapping[str, Tensor], camera: Camera, phase: Phase) -> Used | None:
        """Which anchors a camera uses, whether or not they are in its frustum; None: all of them.

        Args:
            parameters: The parameters.
            camera: The camera.
            phase: The moment.
        """

    def seen(self, parameters: Mapping[str, Tensor], camera: Camera, phase: Phase) -> Seen:
        """The anchors that a camera uses and that are in its frustum."""
        mask = in_frustum(parameters["anchors"], parameters["scales"].detach(), camera)
        used = self.used(parameters, camera, phase)
        if used is None:
            return Seen(mask.nonzero().squeeze(1))
        rows = (mask & used.mask).nonzero().squeeze(1)
        return Seen(rows, None if used.factor is None else used.factor[rows])

    @override
    def decode(self, parameters: Mapping[str, Tensor], camera: Camera, phase: Phase) -> Gaussians:
        seen = self.seen(parameters, camera, phase)
        code = self._code(parameters, camera, training=phase.training)
        return decoded(self.heads, parameters, camera, seen, code)

    def _code(
        self, parameters: Mapping[str, Tensor], camera: Camera, *, training: bool
    ) -> Tensor | None:
        if not self.appearance:
            return None
        codes, poses = parameters[appearance.CODES], parameters[appearance.POSES]
        return appearance.code_of(codes, poses, camera, training=training)

    @override
    def bake(
        self, parameters: Mapping[str, Tensor], phase: Phase, cameras: Sequence[Camera]
    ) -> Gaussians:
        chosen = evenly(cameras, BAKED_CAMERAS)
        views = [(camera, self.seen(parameters, camera, phase)) for camera in chosen]
        code = self._code(parameters, cameras[0], training=False)
        return baked(self.heads, parameters, views, code)

    @hookimpl
    def crossgrad_regularize(self, context: RegularizeContext) -> Regularized | None:
        """The mean volume of what a view draws, times `volume_weight`."""
        if context.gaussians is None or not self.volume_weight:
            return None
        return Regularized(self.volume_weight * mean_volume(context.gaussians))

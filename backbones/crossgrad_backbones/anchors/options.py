"""Options and blocks of the anchor backbones, and appearance codes of the training views."""

from collections.abc import Mapping
from typing import ClassVar

import torch
from pydantic import Field
from torch import Tensor
from typing_extensions import override

from crossgrad_backbones.anchors.heads import Heads
from crossgrad_core.plugin import (
    Backbone,
    Block,
    BlockKind,
    Camera,
    LearningRate,
    Parameters,
    Scene,
    Selection,
)

_FROZEN = LearningRate(0.0)
#: Names of two tensors: codes [V, C] of the training views, and their poses [V, 3, 4] (float64,
#: frozen).
CODES, POSES = "appearance", "appearance_poses"


class AnchorOptions(Backbone):
    """The options of Scaffold-GS. The default values of the options are the published values."""

    default_densifier: ClassVar[str] = "anchor"

    offsets: int = Field(10, ge=1, description="Gaussians per anchor")
    feature: int = Field(32, ge=1, description="width of the features and of the hidden layers")
    opacity_distance: bool = Field(
        default=False, description="whether the opacity depends on the distance"
    )
    cov_distance: bool = Field(
        default=False, description="whether the covariance depends on the distance"
    )
    color_distance: bool = Field(
        default=False, description="whether the colour depends on the distance"
    )
    feature_bank: bool = Field(
        default=False, description="whether to mix the feature at three strides"
    )
    appearance: int = Field(
        0, ge=0, description="width of the appearance code of each training view; 0: none"
    )
    volume_weight: float = Field(
        0.01, ge=0, description="weight of the mean volume in the loss, extents cubed"
    )
    lr_offsets: float = Field(
        0.01, gt=0, description="initial learning rate of the offsets, per scene extent"
    )
    lr_offsets_final: float = Field(
        1e-4, gt=0, description="final learning rate of the offsets, per scene extent"
    )
    lr_features: float = Field(0.0075, ge=0, description="learning rate of the features")
    lr_features_final: float | None = Field(
        None, gt=0, description="final learning rate; null: constant, as published"
    )
    lr_scales: float = Field(0.007, ge=0, description="learning rate of the log scales")
    lr_scales_final: float | None = Field(
        None, gt=0, description="final learning rate; null: constant, as published"
    )
    lr_opacity: float = Field(
        0.002, gt=0, description="initial learning rate of the opacity network"
    )
    lr_opacity_final: float = Field(
        2e-5, gt=0, description="final learning rate of the opacity network"
    )
    lr_cov: float = Field(0.004, ge=0, description="learning rate of the covariance network")
    lr_cov_final: float | None = Field(
        None, gt=0, description="final learning rate; null: constant, as published"
    )
    lr_color: float = Field(0.008, gt=0, description="initial learning rate of the colour network")
    lr_color_final: float = Field(
        5e-5, gt=0, description="final learning rate of the colour network"
    )
    lr_bank: float = Field(0.01, gt=0, description="initial learning rate of the feature bank")
    lr_bank_final: float = Field(1e-5, gt=0, description="final learning rate of the feature bank")
    lr_appearance: float = Field(
        0.05, gt=0, description="initial learning rate of the appearance codes"
    )
    lr_appearance_final: float = Field(
        5e-4, gt=0, description="final learning rate of the appearance codes"
    )

    def unused_options(self, selection: Selection) -> Mapping[str, str]:
        """Return the options that have no effect (see `HasUnusedOptions`)."""
        bank = "there is no feature bank (feature_bank = false); leave the option out"
        codes = "photos have no codes (appearance = 0); leave the option out"
        return {
            **({} if self.feature_bank else {"lr_bank": bank, "lr_bank_final": bank}),
            **({} if self.appearance else {"lr_appearance": codes, "lr_appearance_final": codes}),
        }

    @property
    def heads(self) -> Heads:
        """The networks of the anchors."""
        far = (self.opacity_distance, self.cov_distance, self.color_distance)
        return Heads(self.offsets, self.feature, far, self.appearance, self.feature_bank)

    @override
    def blocks(self) -> tuple[Block, ...]:
        rates = {
            "mlp_opacity": LearningRate(self.lr_opacity, self.lr_opacity_final),
            "mlp_cov": LearningRate(self.lr_cov, self.lr_cov_final),
            "mlp_color": LearningRate(self.lr_color, self.lr_color_final),
            "mlp_bank": LearningRate(self.lr_bank, self.lr_bank_final),
        }
        kinds: dict[str, BlockKind] = {"mlp_cov": "geometry", "mlp_bank": "neutral"}
        offsets = LearningRate(self.lr_offsets, self.lr_offsets_final)
        features = LearningRate(self.lr_features, self.lr_features_final)
        scales = LearningRate(self.lr_scales, self.lr_scales_final)
        return (
            Block("anchors", ("anchors",), True, "geometry", _FROZEN),
            Block("offsets", ("offsets",), True, "geometry", offsets),
            Block("features", ("features",), True, "neutral", features),
            Block("scales", ("scales",), True, "geometry", scales),
            *(n.block(kinds.get(n.name, "appearance"), rates[n.name]) for n in self.heads.networks),
            Block("voxel_size", ("voxel_size",), False, "geometry", _FROZEN),
            *self._appearance_blocks(),
        )

    def _appearance_blocks(self) -> tuple[Block, ...]:
        if not self.appearance:
            return ()
        rate = LearningRate(self.lr_appearance, self.lr_appearance_final)
        codes, poses = CODES, POSES
        return (
            Block(codes, (codes,), False, "appearance", rate),
            Block(poses, (poses,), False, "appearance", _FROZEN),
        )


def created_codes(scene: Scene, codes: Tensor) -> Parameters:
    """Return the appearance tensors: codes and poses of the training views.

    Args:
        scene: The scene with the training views.
        codes: [V, C] initial codes.
    """
    poses = [view.camera.world_to_camera[:3] for view in scene.train_views]
    return {CODES: codes, POSES: torch.stack(poses).double()}


def code_of(codes: Tensor, poses: Tensor, camera: Camera, *, training: bool) -> Tensor:
    """Return the code [C] of a training view during training. In evaluations, return the mean code.

    Scaffold-GS evaluates a held-out view with the code of the training view that has the same
    index. The held-out view and this training view are unrelated. crossgrad evaluates a held-out
    view with the mean code instead.

    Args:
        codes: [V, C] codes of the training views.
        poses: [V, 3, 4] world-to-camera poses of the training views.
        camera: The camera. If several training views have the pose of the camera, the first of
            these views is used.
        training: True if the view is used for training.
    """
    if training:
        pose = camera.world_to_camera[:3].to(poses, non_blocking=True)
        same = (poses == pose).flatten(1).all(1).nonzero()
        if len(same):
            return codes[same[0, 0]]
    return codes.mean(0)

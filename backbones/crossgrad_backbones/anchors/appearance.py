"""Appearance codes: one vector per training view, found by the view's pose."""

import torch
from torch import Tensor

from crossgrad_core.plugin import Camera, Parameters, Scene

#: Names of the codes [V, C] and of the poses [V, 3, 4] (float64, frozen) that they belong to.
CODES, POSES = "appearance", "appearance_poses"


def created_codes(scene: Scene, codes: Tensor) -> Parameters:
    """The tensors of the appearance: the codes of the training views and their poses.

    Args:
        scene: The scene.
        codes: [V, C].
    """
    poses = [view.camera.world_to_camera[:3] for view in scene.train_views]
    return {CODES: codes, POSES: torch.stack(poses).double()}


def code_of(codes: Tensor, poses: Tensor, camera: Camera, *, training: bool) -> Tensor:
    """[C] code of a training view in training, the mean code otherwise.

    Scaffold-GS evaluates a held-out view with the code of the training view that has its running
    number; there is no reason for that view.

    Args:
        codes: [V, C].
        poses: [V, 3, 4] world to camera.
        camera: The camera; cameras of one pose share the code of the first one.
        training: Whether the view is trained on.
    """
    if training:
        own = camera.world_to_camera[:3].to(poses, non_blocking=True)
        same = (poses == own).flatten(1).all(1).nonzero()
        if len(same):
            return codes[same[0, 0]]
    return codes.mean(0)

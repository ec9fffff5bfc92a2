"""Cameras that a program makes up: what is none is refused before it is drawn."""

from math import isfinite
from numbers import Integral, Real

import torch
from torch import Tensor

from crossgrad_core.contract.scene import Camera
from crossgrad_core.errors import UserError


def checked_camera(camera: object) -> Camera:
    """The camera.

    Raises:
        UserError: It is none, or one of its numbers is none of a camera.
    """
    if not isinstance(camera, Camera):
        raise _refused("a view's name or a camera", f"{type(camera).__name__}")
    sides = {"width": camera.width, "height": camera.height}
    for name, side in sides.items():
        if not isinstance(side, Integral) or isinstance(side, bool) or side < 1:
            raise _refused(f"a {name} of 1 pixel or more", repr(side))
    for name in ("fx", "fy", "cx", "cy"):
        value, focal = getattr(camera, name), name in {"fx", "fy"}
        known = isinstance(value, Real) and isfinite(value)
        if not known or (focal and value <= 0):
            above = " above 0" if focal else ""
            raise _refused(f"a finite {name}{above}, in pixels", repr(value))
    if not _is_pose(camera.world_to_camera):
        raise _refused(
            "world_to_camera, a tensor [4, 4] of a rotation and a translation",
            str(camera.world_to_camera).replace("\n", ""),
        )
    return camera


def _is_pose(pose: object) -> bool:
    if not isinstance(pose, Tensor) or pose.shape != (4, 4) or not bool(pose.isfinite().all()):
        return False
    pose = pose.detach().cpu().double()
    rotation, last = pose[:3, :3], pose.new_tensor([0.0, 0.0, 0.0, 1.0])
    straight = torch.allclose(rotation @ rotation.T, torch.eye(3, dtype=pose.dtype), atol=1e-3)
    return straight and float(torch.det(rotation)) > 0 and torch.allclose(pose[3], last)


def _refused(expected: str, found: str) -> UserError:
    return UserError(
        "this is no camera to draw",
        where="Run.render",
        expected=expected,
        found=found,
        todo="take one of `run.scene.views`, or change it with `dataclasses.replace`",
    )

"""Which anchors a camera may see: the frustum filter."""

import math

import torch
from torch import Tensor

from crossgrad_core.rasterizer import ALPHA_THRESHOLD, JACOBIAN_MARGIN
from crossgrad_core.scene.types import Camera

#: Near plane and dilation (px^2) of the filter: the defaults of the rasterizers.
NEAR = 1e-3
DILATION = 0.3
#: Standard deviations at which an opaque Gaussian falls below the alpha threshold.
_REACH = math.sqrt(-2.0 * math.log(ALPHA_THRESHOLD))
#: Where the centre of the first pixel is, from the image's border.
_HALF_PIXEL = 0.5


@torch.no_grad()
def in_frustum(positions: Tensor, log_scales: Tensor, camera: Camera) -> Tensor:
    """[P] bool, anchors whose own Gaussian would reach the image.

    The anchor counts as an opaque, unrotated Gaussian with the scales that stretch its offsets,
    projected by the rules of the rasterizers: it passes where the box around its footprint
    (alpha >= 1/255) holds a pixel centre.

    Args:
        positions: [P, 3] local units.
        log_scales: [P, 3] or more columns, of which the first three are taken.
        camera: The camera.

    Source: Scaffold-GS, section 3.2 (view-frustum filtering).
    """
    pose = camera.world_to_camera.to(positions)
    x, y, z = torch.addmm(pose[:3, 3], positions, pose[:3, :3].T).unbind(1)
    squares = torch.exp(2.0 * log_scales[:, :3])
    inside = z > NEAR
    rows = (
        (x, camera.fx, camera.cx, camera.width, pose[0, :3]),
        (y, camera.fy, camera.cy, camera.height, pose[1, :3]),
    )
    for along, focal, center, size, axis in rows:
        slope = along / z
        margin = JACOBIAN_MARGIN * size / (2.0 * focal)
        clamped = slope.clamp(-center / focal - margin, (size - center) / focal + margin)
        # The row of the Jacobian in the world's axes, times z / focal.
        row = torch.addcmul(axis, clamped[:, None], pose[2, :3], value=-1.0)
        variance = (row.square_() * squares).sum(1) * (focal / z).square() + DILATION
        extent = _REACH * variance.sqrt_()
        place = focal * slope + center
        first, last = _HALF_PIXEL, size - _HALF_PIXEL
        inside &= (place + extent >= first) & (place - extent <= last)
    return inside

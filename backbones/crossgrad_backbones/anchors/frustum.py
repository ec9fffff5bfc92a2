"""Which anchors a camera may see: the frustum filter."""

import math

import numpy as np
import torch
from torch import Tensor

from crossgrad_core.numerics.raster_constants import ALPHA_THRESHOLD, JACOBIAN_MARGIN
from crossgrad_core.plugin import Camera

#: Near plane and dilation (px^2) of the filter: the defaults of the rasterizers.
NEAR, DILATION = 1e-3, 0.3
#: Standard deviations at which an opaque Gaussian falls below the alpha threshold.
REACH = math.sqrt(-2.0 * math.log(ALPHA_THRESHOLD))
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
    tensors = (positions, log_scales)
    if all(each.device.type == "cpu" and each.dtype == torch.float32 for each in tensors):
        return _fused(positions, log_scales, camera)
    return _plain(positions, log_scales, camera)


def _axes(camera: Camera) -> list[tuple[float, ...]]:
    """For x and y: focal length, centre, clamp of the Jacobian's slope, first and last place."""
    sizes = ((camera.fx, camera.cx, camera.width), (camera.fy, camera.cy, camera.height))
    axes: list[tuple[float, ...]] = []
    for focal, center, size in sizes:
        margin = JACOBIAN_MARGIN * size / (2.0 * focal)
        slopes = (-center / focal - margin, (size - center) / focal + margin)
        axes.append((focal, center, *slopes, _HALF_PIXEL, size - _HALF_PIXEL))
    return axes


def _plain(positions: Tensor, log_scales: Tensor, camera: Camera) -> Tensor:
    pose = camera.world_to_camera.to(positions, non_blocking=True)
    *flat, depth = torch.addmm(pose[:3, 3], positions, pose[:3, :3].T).unbind(1)
    squares = torch.exp(2.0 * log_scales[:, :3])
    inside = depth > NEAR
    for along, axis, (focal, center, least, most, first, last) in zip(
        flat, pose, _axes(camera), strict=False
    ):
        slope = along / depth
        # The row of the Jacobian in the world's axes, times depth / focal.
        row = axis[:3] - slope.clamp(least, most)[:, None] * pose[2, :3]
        variance = (row.square() * squares).sum(1) * (focal / depth).square() + DILATION
        extent = REACH * variance.sqrt()
        place = focal * slope + center
        inside &= (place + extent >= first) & (place - extent <= last)
    return inside


def _fused(positions: Tensor, log_scales: Tensor, camera: Camera) -> Tensor:
    from crossgrad_backbones.anchors.numba_kernels import frustum
    from crossgrad_core.numerics.jobs import parallel

    inside = np.empty(len(positions), np.bool_)
    parallel(
        frustum.in_frustum,
        positions.detach().contiguous().numpy(),
        log_scales.detach().contiguous().numpy(),
        camera.world_to_camera[:3].float().numpy(),
        np.array(_axes(camera), np.float32),
        np.float32(NEAR),
        np.float32(DILATION),
        np.float32(REACH),
        inside,
    )
    return torch.from_numpy(inside)

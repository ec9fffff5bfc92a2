"""From world space to the image plane: means, depths and 2-D covariances (EWA splatting)."""

from dataclasses import dataclass

import torch
from torch import Tensor

from crossgrad_core.numerics.raster_constants import JACOBIAN_MARGIN
from crossgrad_core.numerics.rotations import unit_rotation_matrices
from crossgrad_core.plugin import Camera


@dataclass(frozen=True)
class Projection:
    """N Gaussians on the image plane, before any dilation.

    Attributes:
        means: [N, 2] pixels.
        depths: [N] camera depth of the centre, local units.
        xx: [N] entry of the 2-D covariance, px^2; likewise `xy` and `yy`.
        xy: See `xx`.
        yy: See `xx`.
        det: [N] determinant of the 2-D covariance, px^4; never negative.
        factors: [N, 2, 3] projections of the three axes, one standard deviation long, pixels.
    """

    means: Tensor
    depths: Tensor
    xx: Tensor
    xy: Tensor
    yy: Tensor
    det: Tensor
    factors: Tensor


def project(means: Tensor, quats: Tensor, scales: Tensor, camera: Camera) -> Projection:
    """Projects Gaussians by the local affine approximation (EWA, Zwicker et al. 2001).

    Nothing is culled here: a row behind the camera or with a zero quaternion is not finite or has
    no meaning, and the caller leaves it out.

    Args:
        means: [N, 3] local units.
        quats: [N, 4] wxyz, any length.
        scales: [N, 3] local units.
        camera: The camera; cast to the type of `means`.
    """
    pose = camera.world_to_camera.to(means, non_blocking=True)
    x, y, z = (means @ pose[:3, :3].T + pose[:3, 3]).unbind(-1)
    slope_x, slope_y = x / z, y / z
    u = camera.fx * slope_x + camera.cx
    v = camera.fy * slope_y + camera.cy

    # Far outside the image the affine approximation is useless and its Jacobian explodes.
    slope_x = slope_x.clamp(*_slopes(camera.width, camera.fx, camera.cx))
    slope_y = slope_y.clamp(*_slopes(camera.height, camera.fy, camera.cy))
    zero = torch.zeros_like(z)
    row_u = torch.stack([camera.fx / z, zero, -camera.fx * slope_x / z], -1)
    row_v = torch.stack([zero, camera.fy / z, -camera.fy * slope_y / z], -1)
    jacobian = torch.stack([row_u, row_v], 1)  # [N, 2, 3]

    # The covariance is factor @ factor.T. Of a zero quaternion, all of this is NaN.
    axes = unit_rotation_matrices(quats / quats.norm(dim=-1, keepdim=True)) * scales[:, None, :]
    factor = jacobian @ pose[:3, :3] @ axes  # [N, 2, 3]
    first, second = factor.unbind(1)
    # Cauchy-Binet: a sum of squares, where xx * yy - xy^2 would cancel for needles.
    det = torch.linalg.cross(first, second).square().sum(-1)
    xx, xy, yy = first.square().sum(-1), (first * second).sum(-1), second.square().sum(-1)
    return Projection(torch.stack([u, v], -1), z, xx, xy, yy, det, factor)


def _slopes(size: int, focal: float, center: float) -> tuple[float, float]:
    """The range of x / z in which the Jacobian is evaluated: the image and a margin around it."""
    margin = JACOBIAN_MARGIN * size / (2 * focal)
    return -center / focal - margin, (size - center) / focal + margin

"""Convert Gaussians of another pixel response to plain Gaussians, for files and 3DGS viewers."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from crossgrad_backbones.visibility import columns_of, depths_in_view, finest_pixels
from crossgrad_core.numerics.rotations import rotation_matrices
from crossgrad_core.plugin import Camera, Gaussians

#: Number that 3DGS viewers add to both diagonal elements of the 2-D covariance, in px^2.
FILE_DILATION = 0.3
#: After a subtraction, a variance keeps at least this share of its value.
FLOOR = 1e-4


@torch.no_grad()
def as_plain(
    gaussians: Gaussians, cameras: Sequence[Camera], blur: float, near: float
) -> Gaussians:
    """Convert the Gaussians of Mip-Splatting such that a plain 3DGS render gives the same image.

    The response adds the variance `blur` to the 2-D covariance S, and keeps opacity times sqrt(det
    S) constant. A 3DGS viewer adds a larger variance, the dilation. The difference between the
    dilation of the viewer and `blur` is therefore first subtracted from the 3-D variances. For the
    subtraction, a pixel at depth z has the width z / f in local units, with the focal length f. S'
    is the 2-D covariance after the subtraction. The opacity is multiplied by sqrt(det S / det(S' +
    dilation)), the ratio of the footprints.

    The 3-D variances are computed for the camera with the smallest pixels at the Gaussian. The
    opacity is computed for the camera with the largest ratio. If means over the cameras were used
    instead, a Gaussian near some cameras and far from other cameras would be too thin and too
    faint. A Gaussian that no camera sees is unchanged.

    Args:
        gaussians: Gaussians with another pixel response.
        cameras: The cameras; at least one is required.
        blur: Variance that the response adds, in px^2.
        near: Depth of the near plane in local units.
    """
    means, scales = gaussians.means.double(), gaussians.scales.double()
    pixels = finest_pixels(means, cameras, near)
    seen = pixels.isfinite()
    surplus = (FILE_DILATION - blur) * pixels.masked_fill(~seen, 0.0).square()[:, None]
    left = torch.maximum(scales.square() - surplus, FLOOR * scales.square()).sqrt()
    axes = rotation_matrices(gaussians.quats.double())
    ratios = (~seen).to(means)
    for camera in cameras:
        rows = depths_in_view(columns_of(means), camera, near)[1].nonzero().squeeze(1)
        u, v = _projected(axes[rows], means[rows], camera)
        live = _determinant(u, v, scales[rows], 0.0)
        drawn = _determinant(u, v, left[rows], FILE_DILATION)
        ratios[rows] = torch.maximum(ratios[rows], (live / drawn).sqrt())
    return replace(
        gaussians,
        scales=left.to(gaussians.scales),
        opacities=(gaussians.opacities * ratios.to(gaussians.opacities)).clamp(0.0, 1.0),
        response="plain",
        dilation=None,
    )


def _projected(axes: Tensor, means: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Return the horizontal and vertical image components [N, 3] of the axes, in px per local unit.

    Args:
        axes: [N, 3, 3] main axes of the Gaussians as unit vectors, one axis per column.
        means: [N, 3] centres of the Gaussians.
        camera: The camera. Its projection is linearised at the centres.
    """
    pose = camera.world_to_camera.to(means, non_blocking=True)
    x, y, z = (means @ pose[:3, :3].T + pose[:3, 3])[:, :, None].unbind(1)
    row_u = camera.fx / z * (pose[0, :3] - x / z * pose[2, :3])
    row_v = camera.fy / z * (pose[1, :3] - y / z * pose[2, :3])
    return (row_u[:, None] @ axes)[:, 0], (row_v[:, None] @ axes)[:, 0]


def _determinant(u: Tensor, v: Tensor, scales: Tensor, dilation: float) -> Tensor:
    """Return the determinants [N] of the 2-D covariances, in px^4.

    `dilation` is added to the diagonals of the covariances.
    """
    u, v = u * scales, v * scales
    trace = u.square().sum(1) + v.square().sum(1)
    det: Tensor = torch.linalg.cross(u, v).square().sum(1) + dilation * trace + dilation**2
    return det

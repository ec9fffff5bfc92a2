"""Test whether cameras see the centres of Gaussians, and compute pixel sizes at the centres."""

from collections.abc import Sequence

import torch
from torch import Tensor

from crossgrad_core.plugin import Camera

#: A centre counts as seen if the centre is inside the image plus a margin. The margin on each side
#: is this share of the image size.
MARGIN = 0.15
#: Smallest depth of a centre that a camera sees, in local units. The value equals the default near
#: plane of the rasterizers.
NEAR = 1e-3


def columns_of(means: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return x, y and z [N] of means [N, 3] as contiguous tensors without an autograd graph."""
    x, y, z = means.detach().T.contiguous().unbind(0)
    return x, y, z


def depths_in_view(
    columns: tuple[Tensor, Tensor, Tensor], camera: Camera, near: float
) -> tuple[Tensor, Tensor]:
    """Return the depth of each centre in a camera, and a mask of the centres that the camera sees.

    Args:
        columns: x, y and z [N] in the local frame, from `columns_of`.
        camera: The camera.
        near: Smallest depth of a visible centre, in local units.

    Returns:
        Depths [N] and a mask [N]. The mask is True for centres in front of the camera that are
        projected into the image plus a margin of `MARGIN` times its size.
    """
    pose = camera.world_to_camera[:3]
    # The condition |f x / z + c - size / 2| <= (0.5 + MARGIN) size, multiplied by z.
    half_width, half_height = ((0.5 + MARGIN) * size for size in (camera.width, camera.height))
    shift_x, shift_y = camera.cx - camera.width / 2, camera.cy - camera.height / 2
    across = _affine(columns, (camera.fx * pose[0] + shift_x * pose[2]) / half_width)
    down = _affine(columns, (camera.fy * pose[1] + shift_y * pose[2]) / half_height)
    depths = _affine(columns, pose[2])
    reached = torch.maximum(across.abs_(), down.abs_()).clamp_(min=near)
    return depths, (reached <= depths) & (depths > near)


def _affine(columns: tuple[Tensor, Tensor, Tensor], row: Tensor) -> Tensor:
    """Return one coordinate [N] of the transformed points.

    The coordinate is computed element by element. In a matrix product, the rounding of a row may
    depend on its position. The values of a primitive must not change when other primitives are
    added or removed.
    """
    x, y, z = columns
    a, b, c, d = row.tolist()
    result: Tensor = (x * a).add_(y * b).add_(z * c).add_(d)
    return result


def finest_pixels(
    means: Tensor, cameras: Sequence[Camera], near: float, focal: float | None = None
) -> Tensor:
    """Return the smallest z / f [N] over the cameras that see each mean [N, 3].

    The unit is local units per pixel.

    The value is infinite if no camera sees a mean. z is the depth, and f is the focal length fx of
    the camera, or `focal` for all cameras.
    """
    columns = columns_of(means)
    finest = torch.full_like(columns[0], torch.inf)
    for camera in cameras:
        depths, seen = depths_in_view(columns, camera, near)
        pixels = depths.div_(focal or camera.fx).masked_fill_(~seen, torch.inf)
        torch.minimum(finest, pixels, out=finest)
    return finest

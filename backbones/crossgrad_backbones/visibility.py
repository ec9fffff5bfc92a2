"""Visibility of Gaussians by their centres, and the size of a pixel at each centre."""

from collections.abc import Sequence

import torch
from torch import Tensor

from crossgrad_core.plugin import Camera

#: A centre counts as seen if it is inside the enlarged image. The image is enlarged by this share
#: of its size on each side.
MARGIN = 0.15
#: Minimum distance in local units of a centre from the camera that sees it. It is the default of
#: the rasterizers.
NEAR = 1e-3


def columns_of(means: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return x, y and z [N] of means [N, 3], each contiguous, without a graph."""
    x, y, z = means.detach().T.contiguous().unbind(0)
    return x, y, z


def depths_in_view(
    columns: tuple[Tensor, Tensor, Tensor], camera: Camera, near: float
) -> tuple[Tensor, Tensor]:
    """Return the camera depth of each centre, and a mask of the centres that the camera sees.

    Args:
        columns: x, y and z [N] from `columns_of`, local frame.
        camera: The camera.
        near: Centres must be farther than this depth, local units.

    Returns:
        Depths [N] and seen [N] bool: in front, and projected into the image enlarged by `MARGIN`
        of its size on every side.
    """
    pose = camera.world_to_camera[:3]
    # The border |f x / z + c - size / 2| <= (0.5 + MARGIN) size, multiplied by z.
    half_width, half_height = ((0.5 + MARGIN) * size for size in (camera.width, camera.height))
    shift_x, shift_y = camera.cx - camera.width / 2, camera.cy - camera.height / 2
    across = _affine(columns, (camera.fx * pose[0] + shift_x * pose[2]) / half_width)
    down = _affine(columns, (camera.fy * pose[1] + shift_y * pose[2]) / half_height)
    depths = _affine(columns, pose[2])
    reached = torch.maximum(across.abs_(), down.abs_()).clamp_(min=near)
    return depths, (reached <= depths) & (depths > near)


def _affine(columns: tuple[Tensor, Tensor, Tensor], row: Tensor) -> Tensor:
    """Return one coordinate [N] of transformed points.

    The coordinate is computed element by element. A matrix product may round a row differently at
    another position. The values of a primitive must not change if other primitives are added or
    removed.
    """
    x, y, z = columns
    a, b, c, d = row.tolist()
    result: Tensor = (x * a).add_(y * b).add_(z * c).add_(d)
    return result


def finest_pixels(
    means: Tensor, cameras: Sequence[Camera], near: float, focal: float | None = None
) -> Tensor:
    """Return the least z / f [N] over the cameras that see means [N, 3], local units per pixel.

    The value is infinite if no camera sees a mean. f is each camera's own fx, or `focal` for all
    cameras.
    """
    columns = columns_of(means)
    finest = torch.full_like(columns[0], torch.inf)
    for camera in cameras:
        depths, seen = depths_in_view(columns, camera, near)
        pixels = depths.div_(focal or camera.fx).masked_fill_(~seen, torch.inf)
        torch.minimum(finest, pixels, out=finest)
    return finest

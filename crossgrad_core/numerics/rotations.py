"""Convert quaternions to rotation matrices."""

from typing import TypeVar

import torch
from torch import Tensor

#: Numbers, or tensors of equal shape.
T = TypeVar("T", float, Tensor)


def matrix_rows(w: T, x: T, y: T, z: T) -> tuple[tuple[T, T, T], ...]:
    """Return the rows of the rotation matrix of a unit quaternion."""
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def rotation_matrices(quats: Tensor) -> Tensor:
    """Return the rotation matrices [N, 3, 3] of quaternions [N, 4] (w, x, y, z).

    A zero quaternion gives the identity.
    """
    length = quats.norm(dim=-1, keepdim=True)
    return unit_rotation_matrices(quats / torch.where(length > 0, length, 1.0))


def unit_rotation_matrices(quats: Tensor) -> Tensor:
    """Return the rotation matrices [N, 3, 3] of unit quaternions [N, 4] (w, x, y, z)."""
    return torch.stack([torch.stack(row, -1) for row in matrix_rows(*quats.unbind(-1))], -2)

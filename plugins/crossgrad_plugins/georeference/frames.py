"""Similarities from one frame of the world to another."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

#: What a rotation may be off by where its digits were rounded; it is made orthonormal again.
_ROUNDED: Final = 1e-3
_EXACT: Final = 1e-12
_LAST_ROW: Final = np.array([0.0, 0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class Frame3D:
    """A similarity from one frame of the world to another: x' = scale * rotation x + shift.

    Attributes:
        rotation: [3, 3].
        shift: [3].
        scale: Above zero.
    """

    rotation: NDArray[np.float64]
    shift: NDArray[np.float64]
    scale: float = 1.0

    def points(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """[N, 3] points."""
        return np.asarray(self.scale * (points @ self.rotation.T) + self.shift)

    def after(self, first: "Frame3D") -> "Frame3D":
        """Both similarities in one: `first`, then this one."""
        return Frame3D(
            self.rotation @ first.rotation,
            self.points(first.shift[None])[0],
            self.scale * first.scale,
        )

    @property
    def inverse(self) -> "Frame3D":
        """The way from the other frame to the one."""
        turned = self.rotation.T
        return Frame3D(turned, -turned @ self.shift / self.scale, 1.0 / self.scale)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """[4, 4], for columns (x, y, z, 1)."""
        whole = np.eye(4)
        whole[:3, :3], whole[:3, 3] = self.scale * self.rotation, self.shift
        return whole


SAME: Final = Frame3D(np.eye(3), np.zeros(3))


def rotation_of(matrix: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """The rotation [3, 3] that a matrix is, up to the rounding of its digits; None if it is none.

    A matrix that is orthonormal to float64 comes back as it is.
    """
    # What overflows is off as well, and so is what is not a number.
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(matrix.T @ matrix - np.eye(3)).max()
    if not off <= _ROUNDED or np.linalg.det(matrix) < 0.0:
        return None
    if off <= _EXACT:
        return matrix
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ right)


def similarity_of(matrix: NDArray[np.float64]) -> Frame3D | None:
    """The similarity that a matrix [4, 4] is; None where it stretches unevenly or mirrors."""
    with np.errstate(over="ignore", invalid="ignore"):
        scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    if not 0.0 < scale < np.inf or np.abs(matrix[3] - _LAST_ROW).max() > 0.0:
        return None
    rotation = rotation_of(matrix[:3, :3] / scale)
    return None if rotation is None else Frame3D(rotation, matrix[:3, 3], scale)

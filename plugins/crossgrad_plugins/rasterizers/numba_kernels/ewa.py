"""The elliptical weighted average (EWA) projection of one Gaussian, shared by both directions.

Float64 throughout: the kernels are bound by memory here, and needles need the digits.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.raster_constants import JACOBIAN_MARGIN
from crossgrad_plugins.rasterizers.numba_kernels.jit import device

#: px^4; footprints whose determinant is not larger are erased by the antialiased response.
LEAST_DET = 1e-6


Triple = tuple[float, float, float]
Row = tuple[float, float, float, float]
Pose = tuple[Row, Row, Row]


class KernelCamera(NamedTuple):
    """A camera as the kernels take it (all float64).

    Attributes:
        pose: [3, 4] world to camera.
        fx, fy, cx, cy: Pixels.
        left, right, top, bottom: Bounds of x/z and y/z within which the Jacobian is taken.
        width, height: Pixels.
        eye: [3] camera centre, world.
    """

    pose: NDArray[np.float64]
    fx: float
    fy: float
    cx: float
    cy: float
    left: float
    right: float
    top: float
    bottom: float
    width: int
    height: int
    eye: NDArray[np.float64]


def pinhole(
    viewmat: NDArray[np.floating], intrinsics: NDArray[np.floating], width: int, height: int
) -> KernelCamera:
    """Makes a camera from a world-to-camera matrix [4, 4] and K [3, 3]."""
    fx, fy, cx, cy = (float(intrinsics[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    extra_x, extra_y = JACOBIAN_MARGIN * width / (2.0 * fx), JACOBIAN_MARGIN * height / (2.0 * fy)
    pose = np.array(viewmat, dtype=np.float64, order="C")[:3]
    return KernelCamera(
        pose=pose,
        fx=fx,
        fy=fy,
        cx=cx,
        cy=cy,
        left=-cx / fx - extra_x,
        right=(width - cx) / fx + extra_x,
        top=-cy / fy - extra_y,
        bottom=(height - cy) / fy + extra_y,
        width=width,
        height=height,
        eye=-np.linalg.solve(pose[:, :3], pose[:, 3]),
    )


@device
def in_registers(pose: NDArray[np.float64]) -> Pose:
    """Returns a [3, 4] matrix as numbers: loops that write to memory need not read it again."""
    return (
        (pose[0, 0], pose[0, 1], pose[0, 2], pose[0, 3]),
        (pose[1, 0], pose[1, 1], pose[1, 2], pose[1, 3]),
        (pose[2, 0], pose[2, 1], pose[2, 2], pose[2, 3]),
    )


@device
def to_camera(pose: Pose, point: Triple) -> Triple:
    """Returns a point in the camera's frame."""
    x, y, z = point
    return (
        pose[0][0] * x + pose[0][1] * y + pose[0][2] * z + pose[0][3],
        pose[1][0] * x + pose[1][1] * y + pose[1][2] * z + pose[1][3],
        pose[2][0] * x + pose[2][1] * y + pose[2][2] * z + pose[2][3],
    )


@device
def unit_quaternion(quat: Row) -> tuple[Row, float]:
    """Returns the quaternion wxyz at unit length and the inverse of its norm (0 for a zero one)."""
    w, x, y, z = quat
    square = w * w + x * x + y * y + z * z
    inverse = 1.0 / math.sqrt(square) if square > 0.0 else 0.0
    return (w * inverse, x * inverse, y * inverse, z * inverse), inverse


@device
def rotation(unit: Row) -> tuple[Triple, Triple, Triple]:
    """Returns the columns of the rotation matrix of a unit quaternion."""
    w, x, y, z = unit
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        (2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
        (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


@device
def jacobian_rows(
    camera: KernelCamera, pose: Pose, inverse_z: float, slope_x: float, slope_y: float
) -> tuple[Triple, Triple]:
    """Returns both rows of (Jacobian of the projection) x (world-to-camera rotation)."""
    a, b = camera.fx * inverse_z, camera.fy * inverse_z
    return (
        (
            a * (pose[0][0] - slope_x * pose[2][0]),
            a * (pose[0][1] - slope_x * pose[2][1]),
            a * (pose[0][2] - slope_x * pose[2][2]),
        ),
        (
            b * (pose[1][0] - slope_y * pose[2][0]),
            b * (pose[1][1] - slope_y * pose[2][1]),
            b * (pose[1][2] - slope_y * pose[2][2]),
        ),
    )


@device
def dot(a: Triple, b: Triple) -> float:
    """Returns the scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@device
def clamped(value: float, low: float, high: float) -> float:
    """Returns the value moved into [low, high]."""
    return min(max(value, low), high)


@device
def in_axes(row: Triple, columns: tuple[Triple, Triple, Triple]) -> Triple:
    """Returns one row of (projection x rotation): the images of the Gaussian's unit axes."""
    return dot(row, columns[0]), dot(row, columns[1]), dot(row, columns[2])


@device
def times(a: Triple, b: Triple) -> Triple:
    """Returns the products, number by number."""
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


@device
def opacity_factor(raw_det: float, det: float) -> float:
    """Returns what dilation leaves of the opacity at equal energy (Mip-Splatting), 0 if erased."""
    if not (raw_det > LEAST_DET and det > LEAST_DET):
        return 0.0
    return math.sqrt(raw_det / (det + LEAST_DET) + LEAST_DET)


@device
def covariance(
    m: Triple, n: Triple, dilation: float, antialiased: bool
) -> tuple[float, float, float, float, float]:
    """Returns A, B, C and the determinant of [m; n] [m; n]^T + dilation I, and its opacity factor.

    The determinant is a sum of squares (Cauchy-Binet), so that nothing cancels.
    """
    raw_a, b, raw_c = dot(m, m), dot(m, n), dot(n, n)
    raw_det = (
        (m[0] * n[1] - m[1] * n[0]) ** 2
        + (m[0] * n[2] - m[2] * n[0]) ** 2
        + (m[1] * n[2] - m[2] * n[1]) ** 2
    )
    det = raw_det + dilation * (raw_a + raw_c) + dilation * dilation
    factor = opacity_factor(raw_det, det) if antialiased else 1.0
    return raw_a + dilation, b, raw_c + dilation, det, factor

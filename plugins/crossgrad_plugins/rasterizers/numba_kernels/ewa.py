"""The elliptical weighted average (EWA) projection of one Gaussian, and its gradients.

All values are float64. These kernels are limited by memory and not by arithmetic, and thin
Gaussians need the precision.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.raster_constants import JACOBIAN_MARGIN
from crossgrad_plugins.rasterizers.numba_kernels.jit import device
from crossgrad_plugins.rasterizers.numba_kernels.tiles.analytic import SIGMA_FLOOR

#: Limit in px^4. The antialiased response removes footprints whose determinant is at most this
#: limit.
LEAST_DET = 1e-6
Triple = tuple[float, float, float]
Row = tuple[float, float, float, float]
Pose = tuple[Row, Row, Row]


class KernelCamera(NamedTuple):
    """A camera in the form that kernels need (all values float64).

    Attributes:
        pose: [3, 4] matrix from world to camera.
        fx, fy, cx, cy: Focal lengths and principal point, pixels.
        left, right, top, bottom: Bounds of x/z and y/z in the Jacobian.
        width, height: Size of the image, pixels.
        eye: [3] camera centre in the world.
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
    """Return a camera from a world-to-camera matrix [4, 4] and K [3, 3]."""
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
    """Return a [3, 4] matrix as scalars.

    Loops that write to memory then need not read the matrix again.
    """
    return (
        (pose[0, 0], pose[0, 1], pose[0, 2], pose[0, 3]),
        (pose[1, 0], pose[1, 1], pose[1, 2], pose[1, 3]),
        (pose[2, 0], pose[2, 1], pose[2, 2], pose[2, 3]),
    )


@device
def to_camera(pose: Pose, point: Triple) -> Triple:
    """Return a point in the coordinates of the camera."""
    x, y, z = point
    return (
        pose[0][0] * x + pose[0][1] * y + pose[0][2] * z + pose[0][3],
        pose[1][0] * x + pose[1][1] * y + pose[1][2] * z + pose[1][3],
        pose[2][0] * x + pose[2][1] * y + pose[2][2] * z + pose[2][3],
    )


@device
def unit_quaternion(quat: Row) -> tuple[Row, float]:
    """Return a quaternion wxyz of length 1, and the input's inverse length (0 for zero)."""
    w, x, y, z = quat
    square = w * w + x * x + y * y + z * z
    inverse = 1.0 / math.sqrt(square) if square > 0.0 else 0.0
    return (w * inverse, x * inverse, y * inverse, z * inverse), inverse


@device
def rotation(unit: Row) -> tuple[Triple, Triple, Triple]:
    """Return the columns of the rotation matrix of a unit quaternion."""
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
    """Return both rows of (Jacobian of the projection) x (rotation from world to camera)."""
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
    """Return the scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@device
def clamped(value: float, low: float, high: float) -> float:
    """Return the value clamped to [low, high]."""
    return min(max(value, low), high)


@device
def in_axes(row: Triple, columns: tuple[Triple, Triple, Triple]) -> Triple:
    """Return one row of (projection x rotation): the projections of the Gaussian's unit axes."""
    return dot(row, columns[0]), dot(row, columns[1]), dot(row, columns[2])


@device
def times(a: Triple, b: Triple) -> Triple:
    """Return the element-wise products."""
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


@device
def opacity_factor(raw_det: float, det: float) -> float:
    """Return the factor that compensates opacity for dilation (Mip-Splatting).

    The factor 0 means that the Gaussian is removed.
    """
    if not (raw_det > LEAST_DET and det > LEAST_DET):
        return 0.0
    return math.sqrt(raw_det / (det + LEAST_DET) + LEAST_DET)


@device
def covariance(
    m: Triple, n: Triple, dilation: float, antialiased: bool
) -> tuple[float, float, float, float, float]:
    """Return A, B, C and the determinant of [m; n] [m; n]^T + dilation I, and the opacity factor.

    The determinant is computed as a sum of squares (Cauchy-Binet), so that cancellation cannot lose
    precision.
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


@device
def combined(a: Triple, p: float, b: Triple, q: float) -> Triple:
    """Return a p + b q for two vectors p and q."""
    return a[0] * p + b[0] * q, a[1] * p + b[1] * q, a[2] * p + b[2] * q


@device
def covariance_gradient(
    b: float, c: float, det: float, sum_dd: float, sum_dy: float, sum_yy: float
) -> Triple:
    """Return the gradients with respect to A, B and C of the dilated covariance.

    B stands for both off-diagonal entries.
    """
    inverse_c = 1.0 / c
    slope, inverse_variance = b * inverse_c, c / det
    v_variance = 0.5 * inverse_variance * inverse_variance * sum_dd
    v_slope = inverse_variance * inverse_c * sum_dy
    v_decay = 0.5 * inverse_c * inverse_c * sum_yy
    return (
        v_variance,
        v_slope - 2.0 * slope * v_variance,
        v_decay - slope * v_slope + slope * slope * v_variance,
    )


@device
def factor_gradient(
    m: Triple, n: Triple, dilation: float, det: float, factor: float, v_log_factor: float
) -> Triple:
    """Return the part of the gradients with respect to A, B and C from the antialiasing factor."""
    a, b, c = dot(m, m), dot(m, n), dot(n, n)
    raw_det = det - dilation * (a + c) - dilation * dilation
    # With e = LEAST_DET, factor^2 = raw_det / (det + e) + e, so d(log factor) = d(factor^2) / (2
    # factor^2)
    v_square = 0.5 * v_log_factor / (factor * factor)
    v_raw_det = v_square / (det + LEAST_DET)
    v_det = -v_raw_det * raw_det / (det + LEAST_DET)
    return (
        v_raw_det * c + v_det * (c + dilation),
        -2.0 * b * (v_raw_det + v_det),
        v_raw_det * a + v_det * (a + dilation),
    )


@device
def axes_gradient(
    cosine: float,
    sine: float,
    variance_1: float,
    variance_2: float,
    sum_sigma_1: float,
    sum_sigma_2: float,
    v_angle: float,
) -> Triple:
    """Return the gradients with respect to A, B and C for the analytic response.

    B stands for both off-diagonal entries. The input sums are gradients with respect to the
    logarithms of the standard deviations. A standard deviation at its lower bound has no gradient.
    The axes of a round Gaussian have no gradient for their rotation.
    """
    floor = SIGMA_FLOOR * SIGMA_FLOOR
    v_1 = 0.5 * sum_sigma_1 / variance_1 if variance_1 > floor else 0.0
    v_2 = 0.5 * sum_sigma_2 / variance_2 if variance_2 > floor else 0.0
    gap = variance_1 - variance_2
    v_turn = v_angle / gap if gap > 0.0 else 0.0
    mixed = cosine * sine
    return (
        cosine * cosine * v_1 + sine * sine * v_2 - mixed * v_turn,
        2.0 * mixed * (v_1 - v_2) + (cosine * cosine - sine * sine) * v_turn,
        sine * sine * v_1 + cosine * cosine * v_2 + mixed * v_turn,
    )


@device
def turn_gradient(q: Row, inverse_norm: float, x: Triple, y: Triple, z: Triple) -> Row:
    """Return the gradient with respect to a quaternion from the gradients of its matrix columns."""
    w, a, b, c = q
    v_w = 2.0 * (a * (y[2] - z[1]) + b * (z[0] - x[2]) + c * (x[1] - y[0]))
    v_a = 2.0 * (w * (y[2] - z[1]) + b * (x[1] + y[0]) + c * (x[2] + z[0])) - 4.0 * a * (
        y[1] + z[2]
    )
    v_b = 2.0 * (w * (z[0] - x[2]) + a * (x[1] + y[0]) + c * (y[2] + z[1])) - 4.0 * b * (
        x[0] + z[2]
    )
    v_c = 2.0 * (w * (x[1] - y[0]) + a * (x[2] + z[0]) + b * (y[2] + z[1])) - 4.0 * c * (
        x[0] + y[1]
    )
    along = w * v_w + a * v_a + b * v_b + c * v_c
    return (
        (v_w - w * along) * inverse_norm,
        (v_a - a * along) * inverse_norm,
        (v_b - b * along) * inverse_norm,
        (v_c - c * along) * inverse_norm,
    )


@device
def weighted_sum(columns: tuple[Triple, Triple, Triple], weights: Triple) -> Triple:
    """Return the sum of three columns, each times its weight."""
    a, b, c = columns
    p, q, r = weights
    return (
        a[0] * p + b[0] * q + c[0] * r,
        a[1] * p + b[1] * q + c[1] * r,
        a[2] * p + b[2] * q + c[2] * r,
    )

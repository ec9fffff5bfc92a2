"""From the sums per entry to the gradients of the Gaussians' parameters."""

import math

import numpy as np
from numba import prange
from numpy.typing import NDArray

from crossgrad_plugins.rasterizers.numba_kernels.binning import FIRST_SLOT, SLOTS
from crossgrad_plugins.rasterizers.numba_kernels.ewa import (
    LEAST_DET,
    Pinhole,
    axis_lengths,
    clamped,
    covariance,
    dot,
    jacobian_rows,
    rotation,
    to_camera,
    unit_quaternion,
)
from crossgrad_plugins.rasterizers.numba_kernels.jit import device, parallel_kernel
from crossgrad_plugins.rasterizers.numba_kernels.layout import (
    CHUNK,
    PARTIAL,
    SUM_1,
    SUM_ABS_X,
    SUM_ABS_Y,
    SUM_BLUE,
    SUM_D,
    SUM_DD,
    SUM_DEPTH,
    SUM_DY,
    SUM_GREEN,
    SUM_RED,
    SUM_Y,
    SUM_YY,
)
from crossgrad_plugins.rasterizers.numba_kernels.reduction import add_up

@device
def _outer_sum(
    a: tuple[float, float, float], p: float, b: tuple[float, float, float], q: float
) -> tuple[float, float, float]:
    """Returns a p + b q."""
    return a[0] * p + b[0] * q, a[1] * p + b[1] * q, a[2] * p + b[2] * q


@device
def _covariance_gradient(
    b: float, c: float, det: float, sums: NDArray[np.float32]
) -> tuple[float, float, float]:
    """Returns the gradients of A, B (as one number) and C of the dilated covariance."""
    inverse_c = 1.0 / c
    slope, inverse_variance = b * inverse_c, c / det
    v_variance = 0.5 * inverse_variance * inverse_variance * np.float64(sums[SUM_DD])
    v_slope = inverse_variance * inverse_c * np.float64(sums[SUM_DY])
    v_decay = 0.5 * inverse_c * inverse_c * np.float64(sums[SUM_YY])
    return (
        v_variance,
        v_slope - 2.0 * slope * v_variance,
        v_decay - slope * v_slope + slope * slope * v_variance,
    )


@device
def _factor_gradient(
    m: tuple[float, float, float],
    n: tuple[float, float, float],
    dilation: float,
    det: float,
    factor: float,
    v_log_factor: float,
) -> tuple[float, float, float]:
    """Returns what the antialiasing factor adds to the gradients of A, B and C."""
    if factor <= 0.0:
        return 0.0, 0.0, 0.0
    a, b, c = dot(m, m), dot(m, n), dot(n, n)
    raw_det = (
        (m[0] * n[1] - m[1] * n[0]) ** 2
        + (m[0] * n[2] - m[2] * n[0]) ** 2
        + (m[1] * n[2] - m[2] * n[1]) ** 2
    )
    # factor^2 = raw_det / (det + e) + e, so d(log factor) = d(factor^2) / (2 factor^2)
    v_square = 0.5 * v_log_factor / (factor * factor)
    v_raw_det = v_square / (det + LEAST_DET)
    v_det = -v_raw_det * raw_det / (det + LEAST_DET)
    return (
        v_raw_det * c + v_det * (c + dilation),
        -2.0 * b * (v_raw_det + v_det),
        v_raw_det * a + v_det * (a + dilation),
    )


@device
def _turn_gradient(
    q: tuple[float, float, float, float],
    inverse_norm: float,
    x: tuple[float, float, float],
    y: tuple[float, float, float],
    z: tuple[float, float, float],
) -> tuple[float, float, float, float]:
    """Returns the gradient of a quaternion, given those of its rotation matrix' columns."""
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
def _weighted(
    columns: tuple[tuple[float, float, float], ...], weights: tuple[float, float, float]
) -> tuple[float, float, float]:
    """Returns the sum of the three columns times their weights."""
    a, b, c = columns
    p, q, r = weights
    return (
        a[0] * p + b[0] * q + c[0] * r,
        a[1] * p + b[1] * q + c[1] * r,
        a[2] * p + b[2] * q + c[2] * r,
    )


@device
def _unproject_one(
    i: int,
    camera: Pinhole,
    dilation: float,
    antialiased: bool,
    means: NDArray[np.float32],
    quats: NDArray[np.float32],
    scales: NDArray[np.float32],
    opacities: NDArray[np.float32],
    sums: NDArray[np.float32],
    v_depth: float,
    v_means: NDArray[np.float32],
    v_quats: NDArray[np.float32],
    v_scales: NDArray[np.float32],
    v_opacities: NDArray[np.float32],
    v_centres: NDArray[np.float32],
    v_absolute: NDArray[np.float32],
) -> None:
    """Writes the gradients of Gaussian i, given its sums over all pixels."""
    x, y, z = to_camera(camera, means, i)
    qw, qx, qy, qz, inverse_norm = unit_quaternion(quats, i)
    inverse_z = 1.0 / z
    ratio_x, ratio_y = x * inverse_z, y * inverse_z
    slope_x = clamped(ratio_x, camera.left, camera.right)
    slope_y = clamped(ratio_y, camera.top, camera.bottom)
    row_x, row_y = jacobian_rows(camera, inverse_z, slope_x, slope_y)
    columns = rotation(qw, qx, qy, qz)
    p, q = axis_lengths(row_x, columns), axis_lengths(row_y, columns)
    s0, s1, s2 = np.float64(scales[i, 0]), np.float64(scales[i, 1]), np.float64(scales[i, 2])
    m = (p[0] * s0, p[1] * s1, p[2] * s2)
    n = (q[0] * s0, q[1] * s1, q[2] * s2)
    _, b, c, det, factor = covariance(m, n, dilation, antialiased)

    v_a, v_b, v_c = _covariance_gradient(b, c, det, sums)
    if antialiased:
        add_a, add_b, add_c = _factor_gradient(m, n, dilation, det, factor, np.float64(sums[SUM_1]))
        v_a += add_a
        v_b += add_b
        v_c += add_c
    v_m = _outer_sum(m, 2.0 * v_a, n, v_b)
    v_n = _outer_sum(n, 2.0 * v_c, m, v_b)
    v_scales[i, 0] = v_m[0] * p[0] + v_n[0] * q[0]
    v_scales[i, 1] = v_m[1] * p[1] + v_n[1] * q[1]
    v_scales[i, 2] = v_m[2] * p[2] + v_n[2] * q[2]
    v_p = (v_m[0] * s0, v_m[1] * s1, v_m[2] * s2)
    v_q = (v_n[0] * s0, v_n[1] * s1, v_n[2] * s2)
    v_quat = _turn_gradient(
        (qw, qx, qy, qz),
        inverse_norm,
        _outer_sum(row_x, v_p[0], row_y, v_q[0]),
        _outer_sum(row_x, v_p[1], row_y, v_q[1]),
        _outer_sum(row_x, v_p[2], row_y, v_q[2]),
    )
    v_quats[i, 0], v_quats[i, 1], v_quats[i, 2], v_quats[i, 3] = v_quat

    inverse_det = 1.0 / det
    sum_d = np.float64(sums[SUM_D])
    v_u = c * inverse_det * sum_d
    v_v = np.float64(sums[SUM_Y]) / c - b * inverse_det * sum_d
    v_centres[i, 0] = v_u
    v_centres[i, 1] = v_v
    if v_absolute.shape[0] > 0:
        # The sums are in units of the records' decays, log2(e) / 2 of the inverse variances.
        v_absolute[i, 0] = c * inverse_det * np.float64(sums[SUM_ABS_X])
        v_absolute[i, 1] = 2.0 * math.log(2.0) * np.float64(sums[SUM_ABS_Y])

    # row_x = fx / z (pose_x - slope_x pose_z), and the same in y
    pose = camera.pose
    v_row_x = _weighted(columns, v_p)
    v_row_y = _weighted(columns, v_q)
    pose_z = (pose[2, 0], pose[2, 1], pose[2, 2])
    v_inverse_z = z * (dot(row_x, v_row_x) + dot(row_y, v_row_y))
    v_slope_x = -camera.fx * inverse_z * dot(pose_z, v_row_x)
    v_slope_y = -camera.fy * inverse_z * dot(pose_z, v_row_y)
    # u = fx x / z + cx; the Jacobian's slope is x / z only inside its bounds
    v_ratio_x = camera.fx * v_u
    v_ratio_y = camera.fy * v_v
    if slope_x == ratio_x:
        v_ratio_x += v_slope_x
    if slope_y == ratio_y:
        v_ratio_y += v_slope_y
    v_x = v_ratio_x * inverse_z
    v_y = v_ratio_y * inverse_z
    v_inverse_z += v_ratio_x * x + v_ratio_y * y
    v_z = v_depth - inverse_z * inverse_z * v_inverse_z
    for k in range(3):
        v_means[i, k] = pose[0, k] * v_x + pose[1, k] * v_y + pose[2, k] * v_z
    v_opacities[i] = np.float64(sums[SUM_1]) / np.float64(opacities[i])


@parallel_kernel
def unproject(
    camera: Pinhole,
    dilation: float,
    antialiased: bool,
    with_depth: bool,
    means: NDArray[np.float32],
    quats: NDArray[np.float32],
    scales: NDArray[np.float32],
    opacities: NDArray[np.float32],
    drawn: NDArray[np.int64],
    owners: NDArray[np.int32],
    shelves: NDArray[np.int32],
    entry_of_slot: NDArray[np.int32],
    masks: NDArray[np.uint64],
    partials: NDArray[np.float32],
    v_means: NDArray[np.float32],
    v_quats: NDArray[np.float32],
    v_scales: NDArray[np.float32],
    v_opacities: NDArray[np.float32],
    v_colors: NDArray[np.float32],
    v_centres: NDArray[np.float32],
    v_absolute: NDArray[np.float32],
) -> None:
    """Adds up each Gaussian's entries and carries the sums on to its parameters.

    Args:
        camera, dilation, antialiased: As in `project`.
        with_depth: Whether the partial sums hold gradients of the depth.
        means, quats, scales, opacities: As in `project`.
        drawn, owners: From `project`.
        shelves, entry_of_slot: From binning.
        masks: [E] from compositing.
        partials: [(E + 1) * PARTIAL] from `differentiate`, the last row zero.
        v_means: [N, 3] written for Gaussians with entries, zero before; and so on:
        v_quats: [N, 4].
        v_scales: [N, 3].
        v_opacities: [N].
        v_colors: [N, 3], of the RGB drawn.
        v_centres: [N, 2], of the projected mean, per pixel.
        v_absolute: [N, 2], sums of absolute values; [0, 2] where not computed.
    """
    for chunk in prange(drawn.shape[0]):
        sums = np.empty(PARTIAL, np.float32)
        for j in range(chunk * CHUNK, chunk * CHUNK + drawn[chunk]):
            first, count = np.intp(shelves[j, FIRST_SLOT]), np.intp(shelves[j, SLOTS])
            if not add_up(first, count, entry_of_slot, masks, partials, sums):
                continue
            i = np.intp(owners[j])
            v_colors[i, 0] = sums[SUM_RED]
            v_colors[i, 1] = sums[SUM_GREEN]
            v_colors[i, 2] = sums[SUM_BLUE]
            v_depth = 0.0
            if with_depth:
                v_depth = np.float64(sums[SUM_DEPTH])
            _unproject_one(
                i,
                camera,
                dilation,
                antialiased,
                means,
                quats,
                scales,
                opacities,
                sums,
                v_depth,
                v_means,
                v_quats,
                v_scales,
                v_opacities,
                v_centres,
                v_absolute,
            )

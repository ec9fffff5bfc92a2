"""From the sums per entry to the gradients of the Gaussians' parameters."""

import math

import numpy as np
from numba import prange
from numpy.typing import NDArray

from crossgrad_plugins.rasterizers.numba_kernels.analytic import SIGMA_FLOOR, main_axes
from crossgrad_plugins.rasterizers.numba_kernels.binning import FIRST_SLOT, SLOTS
from crossgrad_plugins.rasterizers.numba_kernels.ewa import (
    LEAST_DET,
    Pinhole,
    Row,
    Triple,
    clamped,
    covariance,
    dot,
    in_axes,
    in_registers,
    jacobian_rows,
    rotation,
    times,
    to_camera,
    unit_quaternion,
)
from crossgrad_plugins.rasterizers.numba_kernels.jit import device, parallel_kernel
from crossgrad_plugins.rasterizers.numba_kernels.layout import (
    BLOCK,
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
    SUM_SIGMA_1,
    SUM_SIGMA_2,
    SUM_TURN,
    SUM_U,
    SUM_V,
    SUM_Y,
    SUM_YY,
)
from crossgrad_plugins.rasterizers.numba_kernels.reduction import add_up

# Rows of a block: the sums by their own numbers, what its Gaussians bring along, what is found.
_MEAN = PARTIAL
_QUAT = _MEAN + 3
_SCALE = _QUAT + 4
_V_MEAN = _SCALE + 3
_V_QUAT = _V_MEAN + 3
_V_SCALE = _V_QUAT + 4
_V_CENTRE = _V_SCALE + 3
_INVERSE_VARIANCE = _V_CENTRE + 2
_ROWS = _INVERSE_VARIANCE + 1


@device
def _outer_sum(
    a: Triple, p: float, b: Triple, q: float
) -> Triple:
    """Returns a p + b q."""
    return a[0] * p + b[0] * q, a[1] * p + b[1] * q, a[2] * p + b[2] * q


@device
def _covariance_gradient(
    b: float, c: float, det: float, sum_dd: float, sum_dy: float, sum_yy: float
) -> Triple:
    """Returns the gradients of A, B (as one number) and C of the dilated covariance."""
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
def _factor_gradient(
    m: Triple, n: Triple, dilation: float, det: float, factor: float, v_log_factor: float
) -> Triple:
    """Returns what the antialiasing factor adds to the gradients of A, B and C."""
    a, b, c = dot(m, m), dot(m, n), dot(n, n)
    raw_det = det - dilation * (a + c) - dilation * dilation
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
def _axes_gradient(
    cosine: float,
    sine: float,
    variance_1: float,
    variance_2: float,
    sum_sigma_1: float,
    sum_sigma_2: float,
    v_angle: float,
) -> Triple:
    """Returns the gradients of A, B (as one number) and C of the analytic response.

    The sums are those of gradients by the logarithms of the standard deviations. A floored one has
    no gradient, and the axes of a round Gaussian do not turn.
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
def _turn_gradient(
    q: Row,
    inverse_norm: float,
    x: Triple,
    y: Triple,
    z: Triple,
) -> Row:
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
    columns: tuple[Triple, Triple, Triple], weights: Triple
) -> Triple:
    """Returns the sum of the three columns times their weights."""
    a, b, c = columns
    p, q, r = weights
    return (
        a[0] * p + b[0] * q + c[0] * r,
        a[1] * p + b[1] * q + c[1] * r,
        a[2] * p + b[2] * q + c[2] * r,
    )


@device
def _unproject_block(
    count: int,
    camera: Pinhole,
    dilation: float,
    antialiased: bool,
    analytic: NDArray[np.float32] | None,
    block: NDArray[np.float64],
) -> None:
    """Finds the gradients of `count` Gaussians; no branches on them, so it is vectorised."""
    pose = in_registers(camera.pose)
    pose_z = (pose[2][0], pose[2][1], pose[2][2])
    for k in range(count):
        x, y, z = to_camera(pose, block[_MEAN * BLOCK + k], block[(_MEAN + 1) * BLOCK + k], block[(_MEAN + 2) * BLOCK + k])
        qw, qx, qy, qz, inverse_norm = unit_quaternion(
            block[_QUAT * BLOCK + k], block[(_QUAT + 1) * BLOCK + k], block[(_QUAT + 2) * BLOCK + k], block[(_QUAT + 3) * BLOCK + k]
        )
        scale = block[_SCALE * BLOCK + k], block[(_SCALE + 1) * BLOCK + k], block[(_SCALE + 2) * BLOCK + k]
        inverse_z = 1.0 / z
        ratio_x, ratio_y = x * inverse_z, y * inverse_z
        slope_x = clamped(ratio_x, camera.left, camera.right)
        slope_y = clamped(ratio_y, camera.top, camera.bottom)
        row_x, row_y = jacobian_rows(camera, pose, inverse_z, slope_x, slope_y)
        columns = rotation(qw, qx, qy, qz)
        p, q = in_axes(row_x, columns), in_axes(row_y, columns)
        m, n = times(p, scale), times(q, scale)
        a, b, c, det, factor = covariance(m, n, dilation, antialiased)

        if analytic is None:
            v_a, v_b, v_c = _covariance_gradient(
                b,
                c,
                det,
                block[SUM_DD * BLOCK + k],
                block[SUM_DY * BLOCK + k],
                block[SUM_YY * BLOCK + k],
            )
            if antialiased:
                add_a, add_b, add_c = _factor_gradient(
                    m, n, dilation, det, factor, block[SUM_1 * BLOCK + k]
                )
                v_a += add_a
                v_b += add_b
                v_c += add_c
            inverse_det = 1.0 / det
            v_u = c * inverse_det * block[SUM_D * BLOCK + k]
            v_v = block[SUM_Y * BLOCK + k] / c - b * inverse_det * block[SUM_D * BLOCK + k]
            block[_INVERSE_VARIANCE * BLOCK + k] = c * inverse_det
        else:
            cosine, sine, variance_1, variance_2 = main_axes(a, b, c, det)
            v_a, v_b, v_c = _axes_gradient(
                cosine,
                sine,
                variance_1,
                variance_2,
                block[SUM_SIGMA_1 * BLOCK + k],
                block[SUM_SIGMA_2 * BLOCK + k],
                block[SUM_TURN * BLOCK + k],
            )
            v_u = sine * block[SUM_V * BLOCK + k] - cosine * block[SUM_U * BLOCK + k]
            v_v = -sine * block[SUM_U * BLOCK + k] - cosine * block[SUM_V * BLOCK + k]
        v_m = _outer_sum(m, 2.0 * v_a, n, v_b)
        v_n = _outer_sum(n, 2.0 * v_c, m, v_b)
        v_p, v_q = times(v_m, scale), times(v_n, scale)
        block[_V_SCALE * BLOCK + k] = v_m[0] * p[0] + v_n[0] * q[0]
        block[(_V_SCALE + 1) * BLOCK + k] = v_m[1] * p[1] + v_n[1] * q[1]
        block[(_V_SCALE + 2) * BLOCK + k] = v_m[2] * p[2] + v_n[2] * q[2]
        v_quat = _turn_gradient(
            (qw, qx, qy, qz),
            inverse_norm,
            _outer_sum(row_x, v_p[0], row_y, v_q[0]),
            _outer_sum(row_x, v_p[1], row_y, v_q[1]),
            _outer_sum(row_x, v_p[2], row_y, v_q[2]),
        )
        block[_V_QUAT * BLOCK + k] = v_quat[0]
        block[(_V_QUAT + 1) * BLOCK + k] = v_quat[1]
        block[(_V_QUAT + 2) * BLOCK + k] = v_quat[2]
        block[(_V_QUAT + 3) * BLOCK + k] = v_quat[3]

        block[_V_CENTRE * BLOCK + k] = v_u
        block[(_V_CENTRE + 1) * BLOCK + k] = v_v

        # row_x = fx / z (pose_x - slope_x pose_z), and the same in y
        v_row_x, v_row_y = _weighted(columns, v_p), _weighted(columns, v_q)
        v_slope_x = -camera.fx * inverse_z * dot(pose_z, v_row_x)
        v_slope_y = -camera.fy * inverse_z * dot(pose_z, v_row_y)
        # u = fx x / z + cx; the Jacobian's slope is x / z only inside its bounds
        v_ratio_x = camera.fx * v_u + (v_slope_x if slope_x == ratio_x else 0.0)
        v_ratio_y = camera.fy * v_v + (v_slope_y if slope_y == ratio_y else 0.0)
        v_inverse_z = z * (dot(row_x, v_row_x) + dot(row_y, v_row_y))
        v_inverse_z += v_ratio_x * x + v_ratio_y * y
        v_x, v_y = v_ratio_x * inverse_z, v_ratio_y * inverse_z
        v_z = block[SUM_DEPTH * BLOCK + k] - inverse_z * inverse_z * v_inverse_z
        block[_V_MEAN * BLOCK + k] = pose[0][0] * v_x + pose[1][0] * v_y + pose[2][0] * v_z
        block[(_V_MEAN + 1) * BLOCK + k] = pose[0][1] * v_x + pose[1][1] * v_y + pose[2][1] * v_z
        block[(_V_MEAN + 2) * BLOCK + k] = pose[0][2] * v_x + pose[1][2] * v_y + pose[2][2] * v_z


@device
def _bring(
    i: int,
    k: int,
    used: int,
    sums: NDArray[np.float32],
    means: NDArray[np.float32],
    quats: NDArray[np.float32],
    scales: NDArray[np.float32],
    block: NDArray[np.float64],
) -> None:
    """Puts the first `used` sums and the parameters of Gaussian i into place k of a block."""
    for number in range(SUM_DEPTH + 1):
        block[number * BLOCK + k] = sums[number] if number < used else 0.0
    for axis in range(3):
        block[(_MEAN + axis) * BLOCK + k] = means[i, axis]
        block[(_SCALE + axis) * BLOCK + k] = scales[i, axis]
    for axis in range(4):
        block[(_QUAT + axis) * BLOCK + k] = quats[i, axis]


@parallel_kernel
def unproject(
    camera: Pinhole,
    dilation: float,
    antialiased: bool,
    analytic: NDArray[np.float32] | None,
    with_depth: bool,
    means: NDArray[np.float32],
    quats: NDArray[np.float32],
    scales: NDArray[np.float32],
    opacities: NDArray[np.float32],
    drawn: NDArray[np.int64],
    owners: NDArray[np.int32],
    shelves: NDArray[np.int32],
    written: NDArray[np.uint8],
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
        camera, dilation, antialiased, analytic: As in `project`.
        with_depth: Whether the partial sums hold gradients of the depth.
        means, quats, scales, opacities: As in `project`.
        drawn, owners: From `project`.
        shelves: From binning.
        written: [slots] from `differentiate`.
        partials: [(slots + 1) * PARTIAL] from `differentiate`, the last row zero.
        v_means: [N, 3] written for Gaussians with entries, zero before; and so on:
        v_quats: [N, 4].
        v_scales: [N, 3].
        v_opacities: [N].
        v_colors: [N, 3], of the RGB drawn.
        v_centres: [N, 2], of the projected mean, per pixel.
        v_absolute: [N, 2], sums of absolute values; [0, 2] where not computed.
    """
    used = SUM_DEPTH + 1 if with_depth else SUM_DEPTH
    for chunk in prange(drawn.shape[0]):
        sums = np.empty(PARTIAL, np.float32)
        block = np.empty(_ROWS * BLOCK, np.float64)
        numbers = np.empty(BLOCK, np.int64)
        begin = chunk * CHUNK
        j = begin
        while j < begin + drawn[chunk]:
            size = 0
            while size < BLOCK and j < begin + drawn[chunk]:
                first, count = np.intp(shelves[j, FIRST_SLOT]), np.intp(shelves[j, SLOTS])
                i = np.intp(owners[j])
                j += 1
                if not add_up(first, count, written, partials, sums):
                    continue
                v_colors[i, 0] = sums[SUM_RED]
                v_colors[i, 1] = sums[SUM_GREEN]
                v_colors[i, 2] = sums[SUM_BLUE]
                v_opacities[i] = np.float64(sums[SUM_1]) / np.float64(opacities[i])
                if v_absolute.shape[0] > 0:
                    v_absolute[i, 0] = sums[SUM_ABS_X]
                    v_absolute[i, 1] = sums[SUM_ABS_Y]
                _bring(i, size, used, sums, means, quats, scales, block)
                numbers[size] = i
                size += 1
            _unproject_block(size, camera, dilation, antialiased, analytic, block)
            for k in range(size):
                i = numbers[k]
                for axis in range(3):
                    v_means[i, axis] = block[(_V_MEAN + axis) * BLOCK + k]
                    v_scales[i, axis] = block[(_V_SCALE + axis) * BLOCK + k]
                for axis in range(4):
                    v_quats[i, axis] = block[(_V_QUAT + axis) * BLOCK + k]
                for axis in range(2):
                    v_centres[i, axis] = block[(_V_CENTRE + axis) * BLOCK + k]
                if analytic is None and v_absolute.shape[0] > 0:
                    # These sums are in units of the decays of the records.
                    v_absolute[i, 0] *= block[_INVERSE_VARIANCE * BLOCK + k]
                    v_absolute[i, 1] *= 2.0 * math.log(2.0)

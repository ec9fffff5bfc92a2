"""Conversion of the sums per Gaussian and tile to gradients of the Gaussians' parameters."""

import math

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jobs import Jobs, next_job
from crossgrad_plugins.rasterizers.numba_kernels.binning import FIRST_SLOT, SLOTS
from crossgrad_plugins.rasterizers.numba_kernels.blocks import (
    BLOCK,
    get,
    get_four,
    get_three,
    put,
    put_four,
    put_three,
)
from crossgrad_plugins.rasterizers.numba_kernels.ewa import (
    KernelCamera,
    axes_gradient,
    clamped,
    combined,
    covariance,
    covariance_gradient,
    dot,
    factor_gradient,
    in_axes,
    in_registers,
    jacobian_rows,
    rotation,
    times,
    to_camera,
    turn_gradient,
    unit_quaternion,
    weighted_sum,
)
from crossgrad_plugins.rasterizers.numba_kernels.jit import device, kernel
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
    SUM_SIGMA_1,
    SUM_SIGMA_2,
    SUM_TURN,
    SUM_U,
    SUM_V,
    SUM_Y,
    SUM_YY,
)
from crossgrad_plugins.rasterizers.numba_kernels.reduction import add_up
from crossgrad_plugins.rasterizers.numba_kernels.tiles.analytic import main_axes

# Rows of a block: first the sums in the order of the layout, then the parameters of the Gaussians,
# then the results.
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
def _unproject_block(
    count: int,
    camera: KernelCamera,
    dilation: float,
    antialiased: bool,
    analytic: NDArray[np.float32] | None,
    block: NDArray[np.float64],
) -> None:
    """Compute the gradients of `count` Gaussians in a vectorised loop without branches."""
    pose = in_registers(camera.pose)
    pose_x, pose_y, pose_z = pose[0][:3], pose[1][:3], pose[2][:3]
    for k in range(count):
        x, y, z = to_camera(pose, get_three(block, _MEAN, k))
        unit, inverse_norm = unit_quaternion(get_four(block, _QUAT, k))
        scale = get_three(block, _SCALE, k)
        inverse_z = 1.0 / z
        ratio_x, ratio_y = x * inverse_z, y * inverse_z
        slope_x = clamped(ratio_x, camera.left, camera.right)
        slope_y = clamped(ratio_y, camera.top, camera.bottom)
        row_x, row_y = jacobian_rows(camera, pose, inverse_z, slope_x, slope_y)
        columns = rotation(unit)
        p, q = in_axes(row_x, columns), in_axes(row_y, columns)
        m, n = times(p, scale), times(q, scale)
        a, b, c, det, factor = covariance(m, n, dilation, antialiased)

        if analytic is None:
            v_a, v_b, v_c = covariance_gradient(
                b, c, det, get(block, SUM_DD, k), get(block, SUM_DY, k), get(block, SUM_YY, k)
            )
            if antialiased:
                add_a, add_b, add_c = factor_gradient(
                    m, n, dilation, det, factor, get(block, SUM_1, k)
                )
                v_a += add_a
                v_b += add_b
                v_c += add_c
            inverse_det = 1.0 / det
            v_u = c * inverse_det * get(block, SUM_D, k)
            v_v = get(block, SUM_Y, k) / c - b * inverse_det * get(block, SUM_D, k)
            put(block, _INVERSE_VARIANCE, k, c * inverse_det)
        else:
            cosine, sine, variance_1, variance_2 = main_axes(a, b, c, det)
            v_a, v_b, v_c = axes_gradient(
                cosine,
                sine,
                variance_1,
                variance_2,
                get(block, SUM_SIGMA_1, k),
                get(block, SUM_SIGMA_2, k),
                get(block, SUM_TURN, k),
            )
            v_u = sine * get(block, SUM_V, k) - cosine * get(block, SUM_U, k)
            v_v = -sine * get(block, SUM_U, k) - cosine * get(block, SUM_V, k)
        put(block, _V_CENTRE, k, v_u)
        put(block, _V_CENTRE + 1, k, v_v)

        v_m = combined(m, 2.0 * v_a, n, v_b)
        v_n = combined(n, 2.0 * v_c, m, v_b)
        v_p, v_q = times(v_m, scale), times(v_n, scale)
        by_m, by_n = times(v_m, p), times(v_n, q)
        put_three(block, _V_SCALE, k, combined(by_m, 1.0, by_n, 1.0))
        v_quat = turn_gradient(
            unit,
            inverse_norm,
            combined(row_x, v_p[0], row_y, v_q[0]),
            combined(row_x, v_p[1], row_y, v_q[1]),
            combined(row_x, v_p[2], row_y, v_q[2]),
        )
        put_four(block, _V_QUAT, k, v_quat)

        # row_x = fx / z (pose_x - slope_x pose_z), and analogously in y
        v_row_x, v_row_y = weighted_sum(columns, v_p), weighted_sum(columns, v_q)
        v_slope_x = -camera.fx * inverse_z * dot(pose_z, v_row_x)
        v_slope_y = -camera.fy * inverse_z * dot(pose_z, v_row_y)
        # u = fx x / z + cx; in the Jacobian, x / z is the slope only inside its bounds
        v_ratio_x = camera.fx * v_u + (v_slope_x if slope_x == ratio_x else 0.0)
        v_ratio_y = camera.fy * v_v + (v_slope_y if slope_y == ratio_y else 0.0)
        v_inverse_z = z * (dot(row_x, v_row_x) + dot(row_y, v_row_y))
        v_inverse_z += v_ratio_x * x + v_ratio_y * y
        v_z = get(block, SUM_DEPTH, k) - inverse_z * inverse_z * v_inverse_z
        v_camera = v_ratio_x * inverse_z, v_ratio_y * inverse_z, v_z
        put_three(block, _V_MEAN, k, weighted_sum((pose_x, pose_y, pose_z), v_camera))


@device
def _bring(
    i: int,
    k: int,
    with_depth: bool,
    sums: NDArray[np.float32],
    means: NDArray[np.float32],
    quats: NDArray[np.float32],
    scales: NDArray[np.float32],
    block: NDArray[np.float64],
) -> None:
    """Copy the sums and the parameters of Gaussian i to number k of a block."""
    for number in range(SUM_DEPTH):
        put(block, number, k, sums[number])
    put(block, SUM_DEPTH, k, sums[SUM_DEPTH] if with_depth else 0.0)
    for axis in range(3):
        put(block, _MEAN + axis, k, means[i, axis])
        put(block, _SCALE + axis, k, scales[i, axis])
    for axis in range(4):
        put(block, _QUAT + axis, k, quats[i, axis])


@device
def _fill_block(
    first_record: int,
    end: int,
    with_depth: bool,
    means: NDArray[np.float32],
    quats: NDArray[np.float32],
    scales: NDArray[np.float32],
    opacities: NDArray[np.float32],
    owners: NDArray[np.int32],
    buckets: NDArray[np.int32],
    written: NDArray[np.uint8],
    partials: NDArray[np.float32],
    sums: NDArray[np.float32],
    block: NDArray[np.float64],
    numbers: NDArray[np.int64],
    v_opacities: NDArray[np.float32],
    v_colors: NDArray[np.float32],
    v_absolute: NDArray[np.float32],
) -> tuple[int, int]:
    """Fill a block with Gaussians that have gradients.

    Gradients that do not need the projection are written at once.

    Returns:
        The next record, and the number of Gaussians in the block; `numbers` gets their indices.
    """
    size = 0
    j = first_record
    while size < BLOCK and j < end:
        first, count = np.intp(buckets[j, FIRST_SLOT]), np.intp(buckets[j, SLOTS])
        i = np.intp(owners[j])
        j += 1
        has_gradient = add_up(first, count, written, partials, sums)
        v_colors[i, 0] = sums[SUM_RED]
        v_colors[i, 1] = sums[SUM_GREEN]
        v_colors[i, 2] = sums[SUM_BLUE]
        if not has_gradient:
            continue
        v_opacities[i] = np.float64(sums[SUM_1]) / np.float64(opacities[i])
        if v_absolute.shape[0] > 0:
            v_absolute[i, 0] = sums[SUM_ABS_X]
            v_absolute[i, 1] = sums[SUM_ABS_Y]
        _bring(i, size, with_depth, sums, means, quats, scales, block)
        numbers[size] = i
        size += 1
    return j, size


@device
def _write_block(
    size: int,
    analytic: NDArray[np.float32] | None,
    numbers: NDArray[np.int64],
    block: NDArray[np.float64],
    v_means: NDArray[np.float32],
    v_quats: NDArray[np.float32],
    v_scales: NDArray[np.float32],
    v_centres: NDArray[np.float32],
    v_absolute: NDArray[np.float32],
) -> None:
    """Write the gradients of a block."""
    for k in range(size):
        i = numbers[k]
        for axis in range(3):
            v_means[i, axis] = get(block, _V_MEAN + axis, k)
            v_scales[i, axis] = get(block, _V_SCALE + axis, k)
        for axis in range(4):
            v_quats[i, axis] = get(block, _V_QUAT + axis, k)
        for axis in range(2):
            v_centres[i, axis] = get(block, _V_CENTRE + axis, k)
        if analytic is None and v_absolute.shape[0] > 0:
            # These sums are in units of the records' decays.
            v_absolute[i, 0] *= get(block, _INVERSE_VARIANCE, k)
            v_absolute[i, 1] *= 2.0 * math.log(2.0)


@kernel
def project_backward(
    jobs: Jobs,
    camera: KernelCamera,
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
    buckets: NDArray[np.int32],
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
    """Sum the slots of each Gaussian, and convert the sums to gradients of its parameters.

    Args:
        jobs: Work queue from `share`.
        camera: The camera of the view.
        dilation: Variance that was added to both axes of the image, px^2.
        antialiased: True if opacities were lowered to compensate for the dilation.
        analytic: An array with any content selects the analytic response; None selects the plain
            response.
        with_depth: True if the partial sums contain gradients with respect to the depth.
        means: [N, 3] centres.
        quats: [N, 4] rotations wxyz.
        scales: [N, 3] standard deviations.
        opacities: [N] opacities.
        drawn: [chunks] number of records of each chunk.
        owners: [N] Gaussian of each record.
        buckets: [N, BUCKET] range of slots per record.
        written: [slots] flags from `differentiate`: 1 for slots with sums.
        partials: [(slots + 1) * PARTIAL] sums from `differentiate`; the last row is zero.
        v_means: [N, 3] output, which is zero for Gaussians without gradients, like all outputs
            below.
        v_quats: [N, 4] output.
        v_scales: [N, 3] output.
        v_opacities: [N] output.
        v_colors: [N, 3] output with respect to the rendered RGB, only for drawn Gaussians.
        v_centres: [N, 2] output with respect to the projected mean, per pixel.
        v_absolute: [N, 2] output: sums of absolute values of the pixels' gradients; [0, 2] if not
            computed.
    """
    sums = np.empty(PARTIAL, np.float32)
    block = np.empty(_ROWS * BLOCK, np.float64)
    numbers = np.empty(BLOCK, np.int64)
    chunks = drawn.shape[0]
    nothing = np.float32(0.0)
    chunk = next_job(jobs, chunks)
    while chunk < chunks:
        j = chunk * CHUNK
        end = j + drawn[chunk]
        last = min(j + CHUNK, means.shape[0])
        v_means[j:last] = v_quats[j:last] = v_scales[j:last] = nothing
        v_opacities[j:last] = v_centres[j:last] = v_absolute[j:last] = nothing
        while j < end:
            j, size = _fill_block(
                j,
                end,
                with_depth,
                means,
                quats,
                scales,
                opacities,
                owners,
                buckets,
                written,
                partials,
                sums,
                block,
                numbers,
                v_opacities,
                v_colors,
                v_absolute,
            )
            _unproject_block(size, camera, dilation, antialiased, analytic, block)
            _write_block(
                size,
                analytic,
                numbers,
                block,
                v_means,
                v_quats,
                v_scales,
                v_centres,
                v_absolute,
            )
        chunk = next_job(jobs, chunks)

"""Projection of the Gaussians to the image: culling, records of drawn Gaussians, tile boxes."""

import math

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jobs import Jobs, next_job
from crossgrad_core.numerics.raster_constants import ALPHA_THRESHOLD
from crossgrad_plugins.rasterizers.numba_kernels.binning import FIRST_SLOT
from crossgrad_plugins.rasterizers.numba_kernels.blocks import BLOCK, get, put
from crossgrad_plugins.rasterizers.numba_kernels.ewa import (
    KernelCamera,
    Row,
    Triple,
    clamped,
    covariance,
    in_axes,
    in_registers,
    jacobian_rows,
    rotation,
    times,
    to_camera,
    unit_quaternion,
)
from crossgrad_plugins.rasterizers.numba_kernels.jit import device, kernel
from crossgrad_plugins.rasterizers.numba_kernels.layout import (
    BLUE,
    CHUNK,
    DEPTH,
    GREEN,
    RECORD,
    RED,
)
from crossgrad_plugins.rasterizers.numba_kernels.records import (
    CAMERA_DEPTH,
    COVARIANCE,
    DETERMINANT,
    FACTOR,
    FOUND,
    MEAN_U,
    MEAN_V,
    SQUARE,
    VARIANCE_X,
    VARIANCE_Y,
    analytic_shape,
    place_record,
    plain_shape,
    shape_block,
    square,
    write_analytic,
    write_plain,
)

#: Distance, in standard deviations, at which the alpha of a Gaussian with opacity 1 is below the
#: threshold. 1 % is added, because poses may not be exactly rigid.
_SIGMAS = 1.01 * math.sqrt(-2.0 * math.log(ALPHA_THRESHOLD))
#: Tolerance factor for comparisons of depths, which other code rounds differently.
_NEARER = 1.0 - 1e-9


@device
def _three(flat: NDArray[np.float32], k: int) -> Triple:
    return np.float64(flat[3 * k]), np.float64(flat[3 * k + 1]), np.float64(flat[3 * k + 2])


@device
def _four(flat: NDArray[np.float32], k: int) -> Row:
    return (
        np.float64(flat[4 * k]),
        np.float64(flat[4 * k + 1]),
        np.float64(flat[4 * k + 2]),
        np.float64(flat[4 * k + 3]),
    )


@device
def _may_be_drawn(
    size: int,
    camera: KernelCamera,
    near: float,
    dilation: float,
    means: NDArray[np.float32],
    scales: NDArray[np.float32],
    opacities: NDArray[np.float32],
    flags: NDArray[np.uint8],
) -> None:
    """Set `flags` for each of `size` Gaussians that may touch a pixel.

    The loop has no branches, so that LLVM vectorises it. The edge of a footprint is sqrt(2 log(255
    opacity)) standard deviations from the mean. The projected standard deviation is at most as
    large as the projection of a ball whose radius is the largest scale. Both sides of the
    comparisons are multiplied by the depth, to avoid divisions.
    """
    pose = in_registers(camera.pose)
    steep_x = max(abs(camera.left), abs(camera.right))
    steep_y = max(abs(camera.top), abs(camera.bottom))
    ball_x = _SIGMAS * camera.fx * math.sqrt(1.0 + steep_x * steep_x)
    ball_y = _SIGMAS * camera.fy * math.sqrt(1.0 + steep_y * steep_y)
    spare = _SIGMAS * math.sqrt(dilation) + 1.0
    half_x, half_y = 0.5 * camera.width, 0.5 * camera.height
    for k in range(size):
        x, y, z = to_camera(pose, _three(means, k))
        a, b, c = _three(scales, k)
        ball = max(abs(a), abs(b), abs(c))
        opacity = opacities[k]
        off_x = abs(camera.fx * x + (camera.cx - half_x) * z)
        off_y = abs(camera.fy * y + (camera.cy - half_y) * z)
        inside = (off_x <= (half_x + spare) * z + ball_x * ball) & (
            off_y <= (half_y + spare) * z + ball_y * ball
        )
        # A Gaussian with an opacity above 1 has a wider footprint, so it is kept even outside these
        # limits.
        flags[k] = (z > near * _NEARER) & (opacity >= ALPHA_THRESHOLD) & (inside | (opacity > 1.0))


@device
def _picked(
    begin: int,
    size: int,
    flags: NDArray[np.uint8],
    means: NDArray[np.float32],
    quats: NDArray[np.float32],
    scales: NDArray[np.float32],
    opacities: NDArray[np.float32],
    chosen: NDArray[np.int64],
    picked: NDArray[np.float32],
) -> int:
    """Copy the Gaussians of a block that may be drawn to consecutive rows; return their number.

    `chosen` gets the indices of the Gaussians; `picked` gets their means, quaternions, scales and
    opacities.
    """
    count = 0
    for k in range(size):
        if flags[k]:
            chosen[count] = begin + k
            count += 1
    for row in range(count):
        i = chosen[row]
        for axis in range(3):
            picked[3 * row + axis] = means[i, axis]
            picked[7 * BLOCK + 3 * row + axis] = scales[i, axis]
        for axis in range(4):
            picked[3 * BLOCK + 4 * row + axis] = quats[i, axis]
        picked[10 * BLOCK + row] = opacities[i]
    return count


@device
def _project_block(
    count: int,
    camera: KernelCamera,
    dilation: float,
    antialiased: bool,
    means: NDArray[np.float32],
    quats: NDArray[np.float32],
    scales: NDArray[np.float32],
    projected: NDArray[np.float64],
) -> None:
    """Project the first `count` Gaussians, visible or not, in a vectorised loop without branches.

    All arrays are flat, because LLVM must know the distances between rows.
    """
    pose = in_registers(camera.pose)
    for k in range(count):
        x, y, z = to_camera(pose, _three(means, k))
        unit, inverse_norm = unit_quaternion(_four(quats, k))
        scale = _three(scales, k)
        inverse_z = 1.0 / z
        slope_x = clamped(x * inverse_z, camera.left, camera.right)
        slope_y = clamped(y * inverse_z, camera.top, camera.bottom)
        row_x, row_y = jacobian_rows(camera, pose, inverse_z, slope_x, slope_y)
        turned = rotation(unit)
        m, n = times(in_axes(row_x, turned), scale), times(in_axes(row_y, turned), scale)
        a, b, c, det, factor = covariance(m, n, dilation, antialiased)
        put(projected, CAMERA_DEPTH, k, z)
        put(projected, MEAN_U, k, camera.fx * x * inverse_z + camera.cx)
        put(projected, MEAN_V, k, camera.fy * y * inverse_z + camera.cy)
        put(projected, VARIANCE_X, k, a)
        put(projected, COVARIANCE, k, b)
        put(projected, VARIANCE_Y, k, c)
        put(projected, DETERMINANT, k, det if inverse_norm > 0.0 else -1.0)
        put(projected, FACTOR, k, factor)


@device
def _write_color(i: int, j: int, colors: NDArray[np.float32], records: NDArray[np.float32]) -> bool:
    """Write the colour of Gaussian i to record j; return True if it is finite."""
    red, green, blue = colors[i, 0], colors[i, 1], colors[i, 2]
    records[j * RECORD + RED] = red
    records[j * RECORD + GREEN] = green
    records[j * RECORD + BLUE] = blue
    return math.isfinite(red) and math.isfinite(green) and math.isfinite(blue)


@device
def _give_slots(first: int, end: int, boxes: NDArray[np.int32], buckets: NDArray[np.int32]) -> int:
    """Reserve a slot for each tile in the boxes of the records; return the number of slots."""
    slots = 0
    for j in range(first, end):
        buckets[j, FIRST_SLOT] = slots
        slots += np.int64(boxes[j, 1] - boxes[j, 0]) * np.int64(boxes[j, 3] - boxes[j, 2])
    return slots


@device
def _record_block(
    chosen: NDArray[np.int64],
    first_record: int,
    camera: KernelCamera,
    near: float,
    analytic: NDArray[np.float32] | None,
    limits: NDArray[np.int32] | None,
    opacities: NDArray[np.float32],
    colors: NDArray[np.float32] | None,
    projected: NDArray[np.float64],
    radii: NDArray[np.int32],
    records: NDArray[np.float32],
    depths: NDArray[np.float64],
    boxes: NDArray[np.int32],
    owners: NDArray[np.int32],
) -> int:
    """Write the records of the chosen Gaussians that touch a pixel; return the next free record."""
    j = first_record
    width, height = camera.width, camera.height
    for k in range(chosen.size):
        i = chosen[k]
        opacity, z = np.float64(opacities[i]), get(projected, CAMERA_DEPTH, k)
        within = (0.0, width - 1.0, 0.0, height - 1.0)
        if limits is not None:
            published, within = square(k, width, height, projected)
            if z > near and z < math.inf:
                # In the published code, a Gaussian counts as visible even if it touches no pixel.
                radii[i] = published
        if not (z > near and z < math.inf and opacity >= ALPHA_THRESHOLD and opacity < math.inf):
            continue
        if analytic is None:
            radius, pixels, plain = plain_shape(k, width, height, within, projected)
        else:
            radius, pixels, turned = analytic_shape(k, opacity, width, height, within, projected)
        if radius == 0 or (colors is not None and not _write_color(i, j, colors, records)):
            continue
        if analytic is None:
            write_plain(j, plain, records)
        else:
            write_analytic(j, turned, records)
        place_record(
            j, get(projected, MEAN_U, k), get(projected, MEAN_V, k), pixels, records, boxes
        )
        if limits is None:
            radii[i] = radius
        else:
            limits[j, 0] = np.int32(within[0]) // np.int32(SQUARE)
            limits[j, 1] = np.int32(within[1]) // np.int32(SQUARE)
        records[j * RECORD + DEPTH] = z
        depths[j] = z
        owners[j] = i
        j += 1
    return j


@kernel
def listed(drawn: NDArray[np.int64], owners: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return [R] sorted indices of the Gaussians that have a record."""
    rows = np.empty(drawn.sum(), np.int32)
    next_row = 0
    for chunk in range(drawn.shape[0]):
        for j in range(chunk * CHUNK, chunk * CHUNK + drawn[chunk]):
            rows[next_row] = owners[j]
            next_row += 1
    return rows


@kernel
def project(
    jobs: Jobs,
    camera: KernelCamera,
    near: float,
    dilation: float,
    antialiased: bool,
    analytic: NDArray[np.float32] | None,
    limits: NDArray[np.int32] | None,
    means: NDArray[np.float32],
    quats: NDArray[np.float32],
    scales: NDArray[np.float32],
    opacities: NDArray[np.float32],
    colors: NDArray[np.float32] | None,
    radii: NDArray[np.int32],
    records: NDArray[np.float32],
    depths: NDArray[np.float64],
    boxes: NDArray[np.int32],
    owners: NDArray[np.int32],
    buckets: NDArray[np.int32],
    drawn: NDArray[np.int64],
    room: NDArray[np.int64],
) -> None:
    """Project N Gaussians and write records.

    The drawn Gaussians of each chunk use the first records of the chunk.

    Args:
        jobs: Work queue from `share`.
        camera: The camera of the view.
        near: Minimum depth of a drawn Gaussian.
        dilation: Variance that is added to both axes of the image, px^2.
        antialiased: True if opacities are lowered to compensate for the area that the dilation
            adds.
        analytic: An array with any content selects records of the analytic response (without
            dilation); None selects the plain response.
        limits: [N, 2] output per record: first and last column of 16 pixels that it may touch in
            the published footprint; None selects the footprint alpha >= 1/255.
        means: [N, 3] centres.
        quats: [N, 4] rotations wxyz, any length.
        scales: [N, 3] standard deviations.
        opacities: [N] opacities.
        colors: [N, 3] RGB; if None, `sh_forward` later writes the colours of the records.
        radii: [N] output: radius in pixels; 0 if no pixel is touched.
        records: [N * RECORD] output: the records.
        depths: [N] output per record: depth of the centre.
        boxes: [N, 4] output per record: tile columns and rows [x0, x1), [y0, y1).
        owners: [N] output per record: index of the Gaussian.
        buckets: [N, BUCKET] output per record: the first slot, which is the number of tiles in
            earlier boxes of the chunk.
        drawn: [chunks] output: number of records of each chunk.
        room: [chunks] output: number of tiles in the boxes of each chunk.
    """
    count = means.shape[0]
    projected = np.empty(FOUND * BLOCK, np.float64)
    flags = np.ones(BLOCK, np.uint8)
    chosen = np.empty(BLOCK, np.int64)
    picked = np.empty(11 * BLOCK, np.float32)
    chunks = drawn.shape[0]
    chunk = next_job(jobs, chunks)
    while chunk < chunks:
        first = chunk * CHUNK
        end = first
        for begin in range(first, min(first + CHUNK, count), BLOCK):
            size = min(BLOCK, count - begin)
            radii[begin : begin + size] = 0
            if analytic is None and limits is None:
                _may_be_drawn(
                    size,
                    camera,
                    near,
                    dilation,
                    means.reshape(-1)[3 * begin :],
                    scales.reshape(-1)[3 * begin :],
                    opacities[begin:],
                    flags,
                )
            left = _picked(begin, size, flags, means, quats, scales, opacities, chosen, picked)
            _project_block(
                left,
                camera,
                dilation,
                antialiased,
                picked,
                picked[3 * BLOCK :],
                picked[7 * BLOCK :],
                projected,
            )
            if analytic is None:
                shape_block(left, picked[10 * BLOCK :], projected)
            end = _record_block(
                chosen[:left],
                end,
                camera,
                near,
                analytic,
                limits,
                opacities,
                colors,
                projected,
                radii,
                records,
                depths,
                boxes,
                owners,
            )
        drawn[chunk] = end - first
        room[chunk] = _give_slots(first, end, boxes, buckets)
        chunk = next_job(jobs, chunks)

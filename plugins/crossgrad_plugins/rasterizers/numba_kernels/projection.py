"""Projection of the Gaussians to the image: culling, records of those drawn, tile boxes."""

import math

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.rules import ALPHA_THRESHOLD
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
from crossgrad_plugins.rasterizers.numba_kernels.jobs import Jobs, take
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
    analytic_record,
    plain_record,
    square,
)


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
def _project_block(
    count: int,
    camera: KernelCamera,
    dilation: float,
    antialiased: bool,
    means: NDArray[np.float32],
    quats: NDArray[np.float32],
    scales: NDArray[np.float32],
    found: NDArray[np.float64],
) -> None:
    """Projects the first `count` Gaussians, seen or not; no branches, so it is vectorised.

    All arrays are flat: LLVM must see the strides.
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
        put(found, CAMERA_DEPTH, k, z)
        put(found, MEAN_U, k, camera.fx * x * inverse_z + camera.cx)
        put(found, MEAN_V, k, camera.fy * y * inverse_z + camera.cy)
        put(found, VARIANCE_X, k, a)
        put(found, COVARIANCE, k, b)
        put(found, VARIANCE_Y, k, c)
        put(found, DETERMINANT, k, det if inverse_norm > 0.0 else -1.0)
        put(found, FACTOR, k, factor)


@device
def _tint(i: int, j: int, colors: NDArray[np.float32], records: NDArray[np.float32]) -> bool:
    """Writes the colour of Gaussian i to record j; returns whether it is finite."""
    red, green, blue = colors[i, 0], colors[i, 1], colors[i, 2]
    records[j * RECORD + RED] = red
    records[j * RECORD + GREEN] = green
    records[j * RECORD + BLUE] = blue
    return math.isfinite(red) and math.isfinite(green) and math.isfinite(blue)


@device
def _give_slots(first: int, end: int, boxes: NDArray[np.int32], shelves: NDArray[np.int32]) -> int:
    """Reserves a slot for each tile in the records' boxes; returns their number."""
    slots = 0
    for j in range(first, end):
        shelves[j, FIRST_SLOT] = slots
        slots += np.int64(boxes[j, 1] - boxes[j, 0]) * np.int64(boxes[j, 3] - boxes[j, 2])
    return slots


@device
def _record_block(
    begin: int,
    size: int,
    first_record: int,
    camera: KernelCamera,
    near: float,
    analytic: NDArray[np.float32] | None,
    limits: NDArray[np.int32] | None,
    opacities: NDArray[np.float32],
    colors: NDArray[np.float32] | None,
    found: NDArray[np.float64],
    radii: NDArray[np.int32],
    records: NDArray[np.float32],
    depths: NDArray[np.float64],
    boxes: NDArray[np.int32],
    owners: NDArray[np.int32],
) -> int:
    """Makes records of the Gaussians of a block that touch a pixel; returns the next record."""
    j = first_record
    width, height = camera.width, camera.height
    for k in range(size):
        i = begin + k
        radii[i] = 0
        opacity, z = np.float64(opacities[i]), get(found, CAMERA_DEPTH, k)
        within = (0.0, width - 1.0, 0.0, height - 1.0)
        if limits is not None:
            published, within = square(k, width, height, found)
            if z > near and z < math.inf:
                # Seen by the published code, whether or not it touches a pixel.
                radii[i] = published
        if not (z > near and z < math.inf and opacity >= ALPHA_THRESHOLD and opacity < math.inf):
            continue
        if analytic is None:
            radius = plain_record(k, j, opacity, width, height, within, found, records, boxes)
        else:
            radius = analytic_record(k, j, opacity, width, height, within, found, records, boxes)
        if radius == 0 or (colors is not None and not _tint(i, j, colors, records)):
            continue
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
    shelves: NDArray[np.int32],
    drawn: NDArray[np.int64],
    room: NDArray[np.int64],
) -> None:
    """Projects N Gaussians; those drawn of each chunk take the first records of that chunk.

    Args:
        jobs: From `share`.
        camera: The view.
        near: Least depth.
        dilation: Added to both variances, px^2.
        antialiased: Whether opacities are lowered by what the dilation adds in area.
        analytic: Any vector asks for records of the analytic response (with no dilation).
        limits: [N, 2] written per record: first and last column of 16 pixels that it may touch, by
            the published footprint; None asks for the footprint alpha >= 1/255.
        means: [N, 3].
        quats: [N, 4] wxyz, any norm.
        scales: [N, 3] linear.
        opacities: [N].
        colors: [N, 3] RGB; None leaves the records' colours to `shade`.
        radii: [N] written, pixels; 0 where nothing is touched.
        records: [N * RECORD] written.
        depths: [N] written per record.
        boxes: [N, 4] written per record: tile columns and rows [x0, x1), [y0, y1).
        owners: [N] written per record: its Gaussian.
        shelves: [N, SHELF] first slots written per record: tiles of the boxes before it in its
            chunk.
        drawn: [chunks] written: records of each chunk.
        room: [chunks] written: tiles in the boxes of each chunk.
    """
    count = means.shape[0]
    found = np.empty(FOUND * BLOCK, np.float64)
    chunk = take(jobs)
    while chunk < drawn.shape[0]:
        first = chunk * CHUNK
        end = first
        for begin in range(first, min(first + CHUNK, count), BLOCK):
            size = min(BLOCK, count - begin)
            _project_block(
                size,
                camera,
                dilation,
                antialiased,
                means.reshape(-1)[3 * begin :],
                quats.reshape(-1)[4 * begin :],
                scales.reshape(-1)[3 * begin :],
                found,
            )
            end = _record_block(
                begin,
                size,
                end,
                camera,
                near,
                analytic,
                limits,
                opacities,
                colors,
                found,
                radii,
                records,
                depths,
                boxes,
                owners,
            )
        drawn[chunk] = end - first
        room[chunk] = _give_slots(first, end, boxes, shelves)
        chunk = take(jobs)

"""The projected longest axis of each drawn Gaussian, and sums along this axis."""

import math

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jobs import Jobs, next_job
from crossgrad_plugins.rasterizers.numba_kernels.binning import FIRST_SLOT, SLOTS
from crossgrad_plugins.rasterizers.numba_kernels.ewa import (
    KernelCamera,
    clamped,
    dot,
    in_registers,
    jacobian_rows,
    rotation,
    to_camera,
    unit_quaternion,
)
from crossgrad_plugins.rasterizers.numba_kernels.jit import device, kernel
from crossgrad_plugins.rasterizers.numba_kernels.layout import CHUNK
from crossgrad_plugins.rasterizers.numba_kernels.tiles.directions import BINS, FIELDS, SUMS

#: A projected axis that is shorter than this (pixels) points along the viewing direction, so its
#: direction in the image is undefined.
SHORTEST = 1e-6
#: Unit of the gradients from records of the plain response.
_PLAIN_UNIT = 2.0 * math.log(2.0)


@device
def _axis(
    camera: KernelCamera,
    mean: NDArray[np.float32],
    quat: NDArray[np.float32],
    scale: NDArray[np.float32],
) -> tuple[float, float]:
    """Return a / |a|^2, where a is the projected longest axis (one standard deviation), pixels."""
    pose = in_registers(camera.pose)
    x, y, z = to_camera(pose, (np.float64(mean[0]), np.float64(mean[1]), np.float64(mean[2])))
    unit, _ = unit_quaternion(
        (np.float64(quat[0]), np.float64(quat[1]), np.float64(quat[2]), np.float64(quat[3]))
    )
    slope_x = clamped(x / z, camera.left, camera.right)
    slope_y = clamped(y / z, camera.top, camera.bottom)
    row_x, row_y = jacobian_rows(camera, pose, 1.0 / z, slope_x, slope_y)
    column_x, column_y, column_z = rotation(unit)
    longest, column = np.float64(scale[0]), column_x
    if scale[1] > longest:
        longest, column = np.float64(scale[1]), column_y
    if scale[2] > longest:
        longest, column = np.float64(scale[2]), column_z
    across, down = dot(row_x, column) * longest, dot(row_y, column) * longest
    square = across * across + down * down
    if square <= SHORTEST * SHORTEST:
        return 0.0, 0.0
    return across / square, down / square


@kernel
def longest_axes(
    jobs: Jobs,
    camera: KernelCamera,
    means: NDArray[np.float32],
    quats: NDArray[np.float32],
    scales: NDArray[np.float32],
    drawn: NDArray[np.int64],
    owners: NDArray[np.int32],
    axes: NDArray[np.float32],
) -> None:
    """Write the projected longest axis of every record.

    Args:
        jobs: Work queue from `share`.
        camera: The camera.
        means: [N, 3] centres.
        quats: [N, 4] rotations wxyz.
        scales: [N, 3] standard deviations.
        drawn: [chunks] number of records of each chunk, from `project`.
        owners: [N] Gaussian of each record, from `project`.
        axes: [2 N] output, flat, per record: a / |a|^2, where a is the projected longest axis, one
            standard deviation long, in pixels. It is 0 if the axis points along the viewing
            direction.
    """
    chunks = drawn.shape[0]
    chunk = next_job(jobs, chunks)
    while chunk < chunks:
        for j in range(chunk * CHUNK, chunk * CHUNK + drawn[chunk]):
            i = np.intp(owners[j])
            axes[2 * j], axes[2 * j + 1] = _axis(camera, means[i], quats[i], scales[i])
        chunk = next_job(jobs, chunks)


@kernel
def add_directions(
    jobs: Jobs,
    analytic: bool,
    drawn: NDArray[np.int64],
    owners: NDArray[np.int32],
    buckets: NDArray[np.int32],
    written: NDArray[np.uint8],
    found: NDArray[np.float32],
    directions: NDArray[np.float32],
) -> None:
    """Sum the slots of each Gaussian in their order.

    Args:
        jobs: Work queue from `share`.
        analytic: True if the response is analytic.
        drawn: [chunks] number of records of each chunk, from `project`.
        owners: [N] Gaussian of each record, from `project`.
        buckets: [N, BUCKET] range of slots per record.
        written: [slots] flags from `differentiate`: 1 for slots with sums.
        found: [slots * SUMS] sums from `bin_directions`.
        directions: [N, BINS, FIELDS] output for Gaussians with gradients; must be zero at the
            start.
    """
    unit = 1.0 if analytic else _PLAIN_UNIT
    total = np.empty(SUMS, np.float32)
    chunks = drawn.shape[0]
    chunk = next_job(jobs, chunks)
    while chunk < chunks:
        for j in range(chunk * CHUNK, chunk * CHUNK + drawn[chunk]):
            total[:] = np.float32(0.0)
            first = np.intp(buckets[j, FIRST_SLOT])
            for slot in range(first, first + buckets[j, SLOTS]):
                if written[slot]:
                    for k in range(SUMS):
                        total[k] += found[slot * SUMS + k]
            i = np.intp(owners[j])
            for number in range(BINS):
                for field in range(FIELDS):
                    value = np.float64(total[number * FIELDS + field])
                    directions[i, number, field] = value * unit if field in (2, 3) else value
        chunk = next_job(jobs, chunks)

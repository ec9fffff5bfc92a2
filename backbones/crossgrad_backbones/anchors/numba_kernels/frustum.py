"""The frustum filter of the anchors (Numba, CPU, float32)."""

import math

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jit import kernel
from crossgrad_core.numerics.jobs import Jobs, next_job

#: Number of anchors in one job of the work queue.
SHARE = 4096


@kernel
def in_frustum(
    jobs: Jobs,
    positions: NDArray[np.float32],
    log_scales: NDArray[np.float32],
    pose: NDArray[np.float32],
    axes: NDArray[np.float32],
    near: np.float32,
    dilation: np.float32,
    reach: np.float32,
    inside: NDArray[np.bool_],
) -> None:
    """Write a mask of the anchors inside the frustum.

    The formulas are those of the torch version, `_plain`.

    Args:
        jobs: Job counters, passed by `parallel` or `serial`.
        positions: [P, 3] positions.
        log_scales: [P, 3 or more] log scales.
        pose: [3, 4] world-to-camera transform.
        axes: [2, 6] values for x and for y: focal length, principal point, smallest and largest
            slope of the Jacobian, first and last pixel centre.
        near: Smallest depth.
        dilation: Number that is added to the variances, in px^2.
        reach: Half extent of a footprint in standard deviations.
        inside: [P] output, True inside the frustum.
    """
    count = len(positions)
    chunks = (count + SHARE - 1) // SHARE
    chunk = next_job(jobs, chunks)
    while chunk < chunks:
        for p in range(chunk * SHARE, min(count, (chunk + 1) * SHARE)):
            x, y, z = positions[p, 0], positions[p, 1], positions[p, 2]
            depth = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
            passes = depth > near
            for k in range(2):
                if not passes:
                    break
                focal, center = axes[k, 0], axes[k, 1]
                along = pose[k, 0] * x + pose[k, 1] * y + pose[k, 2] * z + pose[k, 3]
                slope = along / depth
                projected = focal * slope + center
                # If the centre is inside the image, no further test is needed.
                if axes[k, 4] <= projected <= axes[k, 5]:
                    continue
                clamped = min(max(slope, axes[k, 2]), axes[k, 3])
                variance = np.float32(0)
                for c in range(3):
                    row = (pose[k, c] - clamped * pose[2, c]) * math.exp(log_scales[p, c])
                    variance += row * row
                ratio = focal / depth
                extent = reach * math.sqrt(variance * ratio * ratio + dilation)
                passes = projected + extent >= axes[k, 4] and projected - extent <= axes[k, 5]
            inside[p] = passes
        chunk = next_job(jobs, chunks)

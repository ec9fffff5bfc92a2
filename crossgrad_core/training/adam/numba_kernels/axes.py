"""Steps of positions, stretched along the axes of their Gaussians (Numba, CPU)."""

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jit import kernel
from crossgrad_core.numerics.jobs import Jobs, alone, share, take

#: Rows of one job; fixed, so that the split does not depend on the number of threads.
_ROWS = 1 << 13
_ONE, _TWO = np.float32(1), np.float32(2)
_SMALLEST = np.finfo(np.float32).tiny

_Floats = NDArray[np.float32]


@kernel
def _move_chunks(
    jobs: Jobs, positions: _Floats, steps: _Floats, factors: _Floats, quats: _Floats
) -> None:
    rows = len(positions)
    chunks = (rows + _ROWS - 1) // _ROWS
    job = take(jobs, chunks)
    while job < chunks:
        for i in range(job * _ROWS, min(rows, (job + 1) * _ROWS)):
            a, b, c = steps[i, 0], steps[i, 1], steps[i, 2]
            w, x, y, z = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
            square = w * w + x * x + y * y + z * z
            # Of a zero quaternion the identity, as `rotation_matrices` has it.
            twice = _TWO / max(square, _SMALLEST)
            xx, yy, zz = twice * x * x, twice * y * y, twice * z * z
            xy, xz, yz = twice * x * y, twice * x * z, twice * y * z
            wx, wy, wz = twice * w * x, twice * w * y, twice * w * z
            r00, r01, r02 = _ONE - (yy + zz), xy - wz, xz + wy
            r10, r11, r12 = xy + wz, _ONE - (xx + zz), yz - wx
            r20, r21, r22 = xz - wy, yz + wx, _ONE - (xx + yy)
            p = factors[i, 0] * (r00 * a + r10 * b + r20 * c)
            q = factors[i, 1] * (r01 * a + r11 * b + r21 * c)
            r = factors[i, 2] * (r02 * a + r12 * b + r22 * c)
            positions[i, 0] += r00 * p + r01 * q + r02 * r
            positions[i, 1] += r10 * p + r11 * q + r12 * r
            positions[i, 2] += r20 * p + r21 * q + r22 * r
        job = take(jobs, chunks)


def move_rows(positions: _Floats, steps: _Floats, factors: _Floats, quats: _Floats) -> None:
    """Adds to positions [N, 3] the steps [N, 3] times factors [N, 3] along the axes of `quats`.

    Args:
        positions: Changed.
        steps: In the frame of the positions.
        factors: By axis.
        quats: [N, 4] rotations, wxyz of any length.
    """
    run = alone if len(positions) <= _ROWS else share
    run(_move_chunks, positions, steps, factors, quats)

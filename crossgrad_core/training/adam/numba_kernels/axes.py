"""Steps of positions, stretched along the axes of their Gaussians (Numba, CPU)."""

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jit import device, kernel
from crossgrad_core.numerics.jobs import Jobs, alone, share, take

#: Rows of one job; fixed, so that the split does not depend on the number of threads.
_ROWS = 1 << 13
#: Rows whose numbers are laid side by side, so that the compiler works on many of them at a time.
_BLOCK = 64
_ONE, _TWO = np.float32(1), np.float32(2)
#: Squares below it have lost their digits.
_SMALLEST = np.float32(1e-30)

_Floats = NDArray[np.float32]


@device
def _stretch(given: _Floats, moved: _Floats) -> None:
    """Turns steps into the frames of the Gaussians, stretches them there, and turns them back.

    Args:
        given: [10, _BLOCK] steps, factors and quaternions; of one that is as good as zero the
            frame is the world's.
        moved: [3, _BLOCK] the steps to take.
    """
    for j in range(_BLOCK):
        a, b, c = given[0, j], given[1, j], given[2, j]
        w, x, y, z = given[6, j], given[7, j], given[8, j], given[9, j]
        square = w * w + x * x + y * y + z * z
        twice = _TWO * (square > _SMALLEST) / max(square, _SMALLEST)
        xx, yy, zz = twice * x * x, twice * y * y, twice * z * z
        xy, xz, yz = twice * x * y, twice * x * z, twice * y * z
        wx, wy, wz = twice * w * x, twice * w * y, twice * w * z
        r00, r01, r02 = _ONE - (yy + zz), xy - wz, xz + wy
        r10, r11, r12 = xy + wz, _ONE - (xx + zz), yz - wx
        r20, r21, r22 = xz - wy, yz + wx, _ONE - (xx + yy)
        p = given[3, j] * (r00 * a + r10 * b + r20 * c)
        q = given[4, j] * (r01 * a + r11 * b + r21 * c)
        r = given[5, j] * (r02 * a + r12 * b + r22 * c)
        moved[0, j] = r00 * p + r01 * q + r02 * r
        moved[1, j] = r10 * p + r11 * q + r12 * r
        moved[2, j] = r20 * p + r21 * q + r22 * r


@kernel
def _move_chunks(
    jobs: Jobs, positions: _Floats, steps: _Floats, factors: _Floats, quats: _Floats
) -> None:
    given, moved = np.zeros((10, _BLOCK), np.float32), np.zeros((3, _BLOCK), np.float32)
    rows = len(positions)
    chunks = (rows + _ROWS - 1) // _ROWS
    job = take(jobs, chunks)
    while job < chunks:
        end = min(rows, (job + 1) * _ROWS)
        for first in range(job * _ROWS, end, _BLOCK):
            count = min(_BLOCK, end - first)
            for j in range(count):
                i = first + j
                given[0, j], given[1, j], given[2, j] = steps[i, 0], steps[i, 1], steps[i, 2]
                given[3, j], given[4, j], given[5, j] = factors[i, 0], factors[i, 1], factors[i, 2]
                given[6, j], given[7, j] = quats[i, 0], quats[i, 1]
                given[8, j], given[9, j] = quats[i, 2], quats[i, 3]
            _stretch(given, moved)
            for j in range(count):
                i = first + j
                positions[i, 0] += moved[0, j]
                positions[i, 1] += moved[1, j]
                positions[i, 2] += moved[2, j]
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

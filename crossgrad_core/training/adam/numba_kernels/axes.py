"""Add position steps that are stretched along the axes of their Gaussians (Numba, CPU)."""

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jit import device, kernel
from crossgrad_core.numerics.jobs import Jobs, next_job, parallel, serial
from crossgrad_core.numerics.simd import (
    LANES,
    Lanes,
    fma,
    larger,
    load_fours,
    load_triples,
    splat,
    store_triples,
    where,
)

#: Number of rows in one job of the work queue. The number is fixed, so that results do not depend
#: on the number of threads.
_ROWS = 1 << 13
_ZERO, _ONE, _TWO = np.float32(0), np.float32(1), np.float32(2)
#: A quaternion with a smaller squared length counts as the identity, because the square has too few
#: significant bits.
_SMALLEST = np.float32(1e-30)

_Floats = NDArray[np.float32]
_Three = tuple[Lanes, Lanes, Lanes]
_Four = tuple[Lanes, Lanes, Lanes, Lanes]


@device
def _stretched(steps: _Three, factors: _Three, quats: _Four) -> _Three:
    """Rotate steps into the axes of the Gaussians, stretch the steps, and rotate the steps back.

    A quaternion that is nearly zero counts as the identity.
    """
    a, b, c = steps
    w, x, y, z = quats
    one, smallest = splat(_ONE), splat(_SMALLEST)
    square = fma(z, z, fma(y, y, fma(w, w, x * x)))
    twice = where(smallest < square, splat(_TWO), splat(_ZERO)) / larger(square, smallest)
    xx, yy, zz = twice * x * x, twice * y * y, twice * z * z
    xy, xz, yz = twice * x * y, twice * x * z, twice * y * z
    wx, wy, wz = twice * w * x, twice * w * y, twice * w * z
    r00, r01, r02 = one - (yy + zz), xy - wz, xz + wy
    r10, r11, r12 = xy + wz, one - (xx + zz), yz - wx
    r20, r21, r22 = xz - wy, yz + wx, one - (xx + yy)
    # Do not change the order of these sums. The order determines the last bits, and runs must be
    # repeatable.
    p = factors[0] * fma(r20, c, fma(r10, b, r00 * a))
    q = factors[1] * fma(r21, c, fma(r01, a, r11 * b))
    r = factors[2] * fma(r22, c, fma(r02, a, r12 * b))
    return (
        fma(r02, r, fma(r00, p, r01 * q)),
        fma(r12, r, fma(r10, p, r11 * q)),
        fma(r22, r, fma(r20, p, r21 * q)),
    )


@kernel
def _move_chunks(
    jobs: Jobs, positions: _Floats, steps: _Floats, factors: _Floats, quats: _Floats
) -> None:
    # Buffers for the last rows of a job, which do not fill a SIMD vector.
    position, step = np.zeros((LANES, 3), np.float32), np.zeros((LANES, 3), np.float32)
    factor, quat = np.zeros((LANES, 3), np.float32), np.zeros((LANES, 4), np.float32)
    rows = len(positions)
    chunks = (rows + _ROWS - 1) // _ROWS
    job = next_job(jobs, chunks)
    while job < chunks:
        first, end = job * _ROWS, min(rows, (job + 1) * _ROWS)
        whole = first + (end - first) // LANES * LANES
        for i in range(first, whole, LANES):
            moved = _stretched(
                load_triples(steps, 3 * i), load_triples(factors, 3 * i), load_fours(quats, 4 * i)
            )
            x, y, z = load_triples(positions, 3 * i)
            store_triples(positions, 3 * i, x + moved[0], y + moved[1], z + moved[2])
        left = end - whole
        if left:
            position[:left], step[:left] = positions[whole:end], steps[whole:end]
            factor[:left], quat[:left] = factors[whole:end], quats[whole:end]
            moved = _stretched(load_triples(step, 0), load_triples(factor, 0), load_fours(quat, 0))
            x, y, z = load_triples(position, 0)
            store_triples(position, 0, x + moved[0], y + moved[1], z + moved[2])
            positions[whole:end] = position[:left]
        job = next_job(jobs, chunks)


def move_rows(positions: _Floats, steps: _Floats, factors: _Floats, quats: _Floats) -> None:
    """Add steps [N, 3], scaled along the axes of the Gaussians, to positions [N, 3].

    Args:
        positions: Positions, changed in place.
        steps: Steps in world coordinates.
        factors: [N, 3] factor of the step along each axis.
        quats: [N, 4] rotations as quaternions (w, x, y, z) of any length.
    """
    run = serial if len(positions) <= _ROWS else parallel
    run(_move_chunks, positions, steps, factors, quats)

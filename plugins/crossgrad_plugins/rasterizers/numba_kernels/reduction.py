"""Sums over the tiles that a record reaches, in a fixed order."""

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jobs import Jobs, next_job
from crossgrad_core.numerics.simd import LANES, load, prefetch, splat, store
from crossgrad_plugins.rasterizers.numba_kernels.binning import FIRST_SLOT, SLOTS
from crossgrad_plugins.rasterizers.numba_kernels.jit import device, kernel
from crossgrad_plugins.rasterizers.numba_kernels.layout import CHUNK, PARTIAL

#: Memory is prefetched for slots this far ahead. The records are consecutive in memory.
_AHEAD = 32


@device
def add_up(
    first: int,
    count: int,
    written: NDArray[np.uint8],
    partials: NDArray[np.float32],
    sums: NDArray[np.float32],
) -> bool:
    """Sum the rows of a record's slots; return True if at least one row was written.

    The last row of `partials` must be zero.
    """
    zeros = written.shape[0]
    low, high = splat(np.float32(0.0)), splat(np.float32(0.0))
    any_written = False
    for slot in range(first, first + count):
        prefetch(partials, min(slot + _AHEAD, zeros) * PARTIAL)
        row = slot if written[slot] else zeros
        any_written |= row == slot
        low = low + load(partials, row * PARTIAL)
        high = high + load(partials, row * PARTIAL + LANES)
    store(sums, 0, low)
    store(sums, LANES, high)
    return any_written


@kernel
def count_pixels(
    jobs: Jobs,
    drawn: NDArray[np.int64],
    owners: NDArray[np.int32],
    buckets: NDArray[np.int32],
    counts: NDArray[np.int32],
    pixels: NDArray[np.int32],
) -> None:
    """Sum for each Gaussian the number of pixels in which it was blended.

    Args:
        jobs: Work queue from `share`.
        drawn: [chunks] number of records of each chunk, from `project`.
        owners: [N] Gaussian of each record, from `project`.
        buckets: [N, BUCKET] range of slots per record.
        counts: [slots] number of pixels per slot.
        pixels: [N] output for the drawn Gaussians; must be zero at the start.
    """
    chunks = drawn.shape[0]
    chunk = next_job(jobs, chunks)
    while chunk < chunks:
        for j in range(chunk * CHUNK, chunk * CHUNK + drawn[chunk]):
            first = np.intp(buckets[j, FIRST_SLOT])
            total = 0
            for slot in range(first, first + buckets[j, SLOTS]):
                total += counts[slot]
            pixels[owners[j]] = total
        chunk = next_job(jobs, chunks)

"""Sums over the tiles that a record reaches, in a fixed order."""

import numpy as np
from numba import prange
from numpy.typing import NDArray

from crossgrad_plugins.rasterizers.numba_kernels.binning import FIRST_SLOT, SLOTS
from crossgrad_plugins.rasterizers.numba_kernels.jit import device, parallel_kernel
from crossgrad_plugins.rasterizers.numba_kernels.layout import CHUNK, PARTIAL
from crossgrad_plugins.rasterizers.numba_kernels.simd import LANES, load, prefetch, splat, store

#: Slots ahead for which memory is asked.
_AHEAD = 24


@device
def add_up(
    first: int,
    count: int,
    entry_of_slot: NDArray[np.int32],
    masks: NDArray[np.uint64],
    partials: NDArray[np.float32],
    sums: NDArray[np.float32],
) -> bool:
    """Adds up the sums of one record's entries; returns whether there were any.

    `partials` ends with a row of zeros.
    """
    zeros = masks.shape[0]
    low, high = splat(np.float32(0.0)), splat(np.float32(0.0))
    found = False
    for slot in range(first, first + count):
        ahead = np.intp(entry_of_slot[min(slot + _AHEAD, entry_of_slot.shape[0] - 1)])
        prefetch(masks, ahead)
        prefetch(partials, ahead * PARTIAL)
        entry = np.intp(entry_of_slot[slot])
        blended = masks[entry] != 0
        # Rows of entries without a mask were never written.
        row = (entry if blended else zeros) * PARTIAL
        found |= blended
        low = low + load(partials, row)
        high = high + load(partials, row + LANES)
    store(sums, 0, low)
    store(sums, LANES, high)
    return found


@parallel_kernel
def count_pixels(
    drawn: NDArray[np.int64],
    owners: NDArray[np.int32],
    shelves: NDArray[np.int32],
    entry_of_slot: NDArray[np.int32],
    counts: NDArray[np.int32],
    pixels: NDArray[np.int32],
) -> None:
    """Adds up the pixels in which each Gaussian was blended.

    Args:
        drawn, owners: From `project`.
        shelves, entry_of_slot: From binning.
        counts: [E] pixels per entry.
        pixels: [N] written for the Gaussians drawn; zero before.
    """
    for chunk in prange(drawn.shape[0]):
        for j in range(chunk * CHUNK, chunk * CHUNK + drawn[chunk]):
            first = np.intp(shelves[j, FIRST_SLOT])
            total = 0
            for slot in range(first, first + shelves[j, SLOTS]):
                total += counts[entry_of_slot[slot]]
            pixels[owners[j]] = total

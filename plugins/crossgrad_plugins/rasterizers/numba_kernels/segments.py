"""Sets of a tile's segments, as bits, the lanes of their pairs, and room for their states."""

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.simd import WIDE, Lanes, even_lanes, odd_lanes
from crossgrad_plugins.rasterizers.numba_kernels.jit import device
from crossgrad_plugins.rasterizers.numba_kernels.layout import UPPER


@device
def upper_of(segments: np.uint64) -> np.uint64:
    """Returns the upper segments of the pairs in which there is one of these segments."""
    return (segments | (segments >> np.uint64(1))) & np.uint64(UPPER)


@device
def lane_of(segment: int, x: int) -> int:
    """Returns the lane of a pair that is pixel x of a segment."""
    return 2 * x + (segment & 1)


@device
def half_of(segment: int, both: Lanes) -> Lanes:
    """Returns the eight of a pair's sixteen lanes that are a segment's."""
    return even_lanes(both) if segment & 1 == 0 else odd_lanes(both)


@device
def aligned(count: int) -> NDArray[np.float32]:
    """Returns room for so many numbers that begins a cache line: no vector lies across two."""
    room = np.empty(count + WIDE, np.float32)
    shift = (-(room.ctypes.data // room.itemsize)) % WIDE
    return room[shift : shift + count]

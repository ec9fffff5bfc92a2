"""Lists of the records that reach each tile, from front to back.

First the tiles of each record are found and stored in consecutive slots, in the order of the
records in memory. Then the tile lists are filled in the order of depth.
"""

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jobs import Jobs, next_job
from crossgrad_core.numerics.simd import (
    LANES,
    Lanes,
    broadcast,
    fma,
    fnma,
    larger,
    load,
    prefetch,
    ramp,
    round_down,
    round_up,
    smaller,
    splat,
    square_root,
    store,
    where,
)
from crossgrad_plugins.rasterizers.numba_kernels.jit import device, kernel
from crossgrad_plugins.rasterizers.numba_kernels.layout import (
    CHUNK,
    LOG_OPACITY,
    RECORD,
    ROW_DECAY,
    SLOPE,
    SPARE,
    TILE_HEIGHT,
    TILE_WIDTH,
    TOUCH,
    U_PART,
    U_WHOLE,
    V_PART,
    V_WHOLE,
    WIDTH,
)
from crossgrad_plugins.rasterizers.numba_kernels.sorting import order_by_depth

#: Number of parts into which the chunks are divided for counting. The number is constant, so that
#: results do not depend on the number of threads.
PARTS = 16

#: Number of records whose spans of tiles are computed before the first of these tiles is written.
#: In a group of records, the processor computes square roots in parallel; one record at a time, it
#: would wait for each of them.
_GROUP = 32

#: Positions of the values of the ellipses in the buffer of a group.
_OF_SLOPE, _OF_DECAY, _OF_WIDTH, _OF_BUDGET, _OF_EXTENT, _OF_TILT = range(0, 6 * _GROUP, _GROUP)

#: Memory is prefetched for records this far ahead: first the slot numbers, then the slots.
_FAR, _NEAR = 32, 16

#: Fields of a record that are needed to fill the lists.
FIRST_SLOT, SLOTS, FIRST_ROW, LAST_ROW = 0, 1, 2, 3
BUCKET = 4


@kernel
def collect(
    drawn: NDArray[np.int64],
    room: NDArray[np.int64],
    depths: NDArray[np.float64],
    buckets: NDArray[np.int32],
) -> tuple[NDArray[np.int32], NDArray[np.float64], int]:
    """Copy the records of all chunks together, without gaps between chunks.

    Args:
        drawn: [chunks] number of records of each chunk.
        room: [chunks] number of slots of each chunk.
        depths: [N] depth of each record.
        buckets: [N, BUCKET] range of slots per record; the first slots are changed to global slot
            numbers.

    Returns:
        The drawn records [M], their depths [M], and the total number of slots.
    """
    total = drawn.sum()
    items = np.empty(total, np.int32)
    keys = np.empty(total, np.float64)
    k = 0
    first_slot = 0
    for chunk in range(drawn.shape[0]):
        for j in range(chunk * CHUNK, chunk * CHUNK + drawn[chunk]):
            items[k] = j
            keys[k] = depths[j]
            buckets[j, FIRST_SLOT] += first_slot
            k += 1
        first_slot += room[chunk]
    return items, keys, first_slot


@device
def _tile(position: Lanes, size: int) -> Lanes:
    """Return the index of the tile that contains a pixel."""
    return round_down(position * splat(np.float32(1.0 / size)))


@device
def _ellipses(
    first: int, last: int, records: NDArray[np.float32], ellipses: NDArray[np.float32]
) -> None:
    """Write the ellipse parameters of a group of records; every row of tiles uses them.

    Square roots and quotients are computed for eight records at the same time.
    """
    for j in range(first, last):
        k, at = j - first, j * RECORD
        ellipses[_OF_SLOPE + k] = records[at + SLOPE]
        ellipses[_OF_DECAY + k] = records[at + ROW_DECAY]
        ellipses[_OF_WIDTH + k] = records[at + WIDTH]
        ellipses[_OF_BUDGET + k] = records[at + LOG_OPACITY] + np.float32(SPARE - TOUCH)
    for k in range(0, last - first, LANES):
        slope, row_decay = load(ellipses, _OF_SLOPE + k), load(ellipses, _OF_DECAY + k)
        width, budget = load(ellipses, _OF_WIDTH + k), load(ellipses, _OF_BUDGET + k)
        # The rightmost point maximises slope dy + sqrt(width (budget - row_decay dy^2)), with the
        # offset dy from the mean.
        extent_y = square_root(budget / row_decay)
        tilt = slope * extent_y / square_root(fma(row_decay, width, slope * slope))
        store(ellipses, _OF_EXTENT + k, extent_y)
        store(ellipses, _OF_TILT + k, tilt)


@device
def _spans(
    at: int,
    k: int,
    first_row: int,
    records: NDArray[np.float32],
    ellipses: NDArray[np.float32],
    begins: NDArray[np.float32],
    ends: NDArray[np.float32],
    lane: int,
) -> None:
    """Write the first and last reached tile in eight rows of tiles; first > last means none.

    The record `at` has ellipse number k of the group.

    The ends of an ellipse in its rows form concave curves. Within a row of tiles, the extreme is at
    the ellipse's leftmost or rightmost point, or in the pixel row nearest to this point.
    """
    zero = splat(np.float32(0.0))
    half = splat(np.float32(0.5))
    # In this function, pixel centres have whole-number coordinates.
    u = broadcast(records, at + U_WHOLE) + (broadcast(records, at + U_PART) - half)
    v = broadcast(records, at + V_WHOLE) + (broadcast(records, at + V_PART) - half)
    slope = broadcast(ellipses, _OF_SLOPE + k)
    row_decay = broadcast(ellipses, _OF_DECAY + k)
    width = broadcast(ellipses, _OF_WIDTH + k)
    budget = broadcast(ellipses, _OF_BUDGET + k)
    extent_y = broadcast(ellipses, _OF_EXTENT + k)
    tilt = broadcast(ellipses, _OF_TILT + k)
    row = ramp() + splat(np.float32(first_row))
    top = row * splat(np.float32(TILE_HEIGHT))
    bottom = smaller(top + splat(np.float32(TILE_HEIGHT - 1)), round_down(v + extent_y)) - v
    top = larger(top, round_up(v - extent_y)) - v
    left = smaller(larger(zero - tilt, top), bottom)
    right = smaller(larger(tilt, top), bottom)
    left_extent = square_root(larger(fnma(row_decay * left, left, budget) * width, zero))
    right_extent = square_root(larger(fnma(row_decay * right, right, budget) * width, zero))
    first = round_up(fma(slope, left, u) - left_extent)
    last = round_down(fma(slope, right, u) + right_extent)
    empty = splat(np.float32(-1.0))
    store(begins, lane, _tile(first, TILE_WIDTH))
    store(ends, lane, where((top <= bottom) & (first <= last), _tile(last, TILE_WIDTH), empty))


@device
def _find(
    j: int,
    tile_columns: int,
    records: NDArray[np.float32],
    boxes: NDArray[np.int32],
    first_slot: int,
    tile_of_slot: NDArray[np.int32],
    counts: NDArray[np.int32],
    ellipses: NDArray[np.float32],
    begins: NDArray[np.float32],
    ends: NDArray[np.float32],
    k: int,
    boxed: bool,
) -> int:
    """Write the tiles that record j (number k of its group) reaches to slots, and count them.

    The spans of the first eight rows of tiles must already be computed, unless the whole box is
    used.

    Returns:
        The number of reached tiles.
    """
    lane = k * LANES
    left, right = np.float32(boxes[j, 0]), np.float32(boxes[j, 1] - 1)
    slot = first_slot
    for block in range(boxes[j, 2], boxes[j, 3], LANES):
        if boxed:
            begins[lane : lane + LANES], ends[lane : lane + LANES] = left, right
        elif block > boxes[j, 2]:
            _spans(j * RECORD, k, block, records, ellipses, begins, ends, lane)
        for row in range(min(LANES, boxes[j, 3] - block)):
            begin = np.intp(max(left, begins[lane + row]))
            end = np.intp(min(right, ends[lane + row]))
            if begin > end:
                continue
            tile = (block + row) * tile_columns + begin
            # Most rows have one or two tiles, and the processor cannot predict how many. One and
            # two tiles are therefore written by code without branches.
            more = np.intp(end > begin)
            tile_of_slot[slot] = tile
            tile_of_slot[slot + more] = tile + more
            counts[tile] += 1
            counts[tile + more] += more
            slot += 1 + more
            for further in range(tile + 2, tile + 1 + end - begin):
                tile_of_slot[slot] = further
                counts[further] += 1
                slot += 1
    return slot - first_slot


@kernel
def find_tiles(
    jobs: Jobs,
    tile_columns: int,
    records: NDArray[np.float32],
    boxes: NDArray[np.int32],
    boxed: bool,
    drawn: NDArray[np.int64],
    buckets: NDArray[np.int32],
    tile_of_slot: NDArray[np.int32],
    counts: NDArray[np.int32],
    depths: NDArray[np.float64],
    order: NDArray[np.int32],
) -> None:
    """Find the tiles that each record reaches; at the same time, one job sorts records by depth.

    Args:
        jobs: Work queue from `share`.
        tile_columns: Number of tiles in a row.
        records: The records, flat.
        boxes: [N, 4] box of tiles per record.
        boxed: True to use all tiles of each box, as for records of the analytic response.
        drawn: [chunks] number of records of each chunk.
        buckets: [N, BUCKET] range of slots per record; this function completes it.
        tile_of_slot: [slots] output: tile of each slot.
        counts: [PARTS, T] output: number of entries per part and tile; must be zero at the start.
        depths: [M] depths of the drawn records.
        order: [M] indices of the drawn records; they are sorted by depth in place.
    """
    chunks = drawn.shape[0]
    ellipses = np.zeros(6 * _GROUP, np.float32)
    begins = np.empty(_GROUP * LANES, np.float32)
    ends = np.empty(_GROUP * LANES, np.float32)
    job = next_job(jobs, PARTS + 1)
    while job <= PARTS:
        # Sorting is one job. It starts first, because it takes the longest time.
        if job == 0:
            order[:] = order_by_depth(depths, order)
            job = next_job(jobs, PARTS + 1)
            continue
        part = job - 1
        for chunk in range(part * chunks // PARTS, (part + 1) * chunks // PARTS):
            last = chunk * CHUNK + drawn[chunk]
            for first in range(chunk * CHUNK, last, _GROUP):
                group = range(first, min(first + _GROUP, last))
                if not boxed:
                    _ellipses(first, group.stop, records, ellipses)
                    for j in group:
                        k, row = j - first, boxes[j, 2]
                        _spans(j * RECORD, k, row, records, ellipses, begins, ends, k * LANES)
                for j in group:
                    buckets[j, SLOTS] = _find(
                        j,
                        tile_columns,
                        records,
                        boxes,
                        np.intp(buckets[j, FIRST_SLOT]),
                        tile_of_slot,
                        counts[part],
                        ellipses,
                        begins,
                        ends,
                        j - first,
                        boxed,
                    )
                    buckets[j, FIRST_ROW] = boxes[j, 2]
                    buckets[j, LAST_ROW] = boxes[j, 3] - 1
        job = next_job(jobs, PARTS + 1)


@kernel
def start_tiles(
    counts: NDArray[np.int32], tile_columns: int, bands: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return the first entry of each tile [T + 1], and divide the rows of tiles into bands.

    Args:
        counts: [PARTS, T] number of entries per part and tile.
        tile_columns: Number of tiles in a row.
        bands: [bands + 1] output: first row of tiles of each band; bands have nearly equal numbers
            of entries.
    """
    tiles = counts.shape[1]
    starts = np.zeros(tiles + 1, np.int64)
    for tile in range(tiles):
        starts[tile + 1] = starts[tile] + counts[:, tile].sum()
    rows = tiles // tile_columns
    last = bands.shape[0] - 1
    row = 0
    for band in range(last):
        bands[band] = row
        while row < rows and starts[row * tile_columns] * last < starts[tiles] * (band + 1):
            row += 1
    bands[last] = rows
    return starts


@kernel
def fill_tiles(
    jobs: Jobs,
    order: NDArray[np.int32],
    tile_columns: int,
    bands: NDArray[np.int64],
    buckets: NDArray[np.int32],
    tile_of_slot: NDArray[np.int32],
    starts: NDArray[np.int64],
    entries: NDArray[np.int32],
) -> None:
    """Write the tile lists; each job writes one band, a group of rows of tiles.

    Args:
        jobs: Work queue from `share`.
        order: [M] indices of records, from front to back.
        tile_columns: Number of tiles in a row.
        bands: [bands + 1] first row of tiles of each band.
        buckets: [N, BUCKET] range of slots per record.
        tile_of_slot: [slots] tile of each slot, from `find_tiles`.
        starts: [T + 1] index of the first entry of each tile.
        entries: [E, 2] output: record and slot of each entry, tile by tile, from front to back.
    """
    count = order.shape[0]
    last = bands.shape[0] - 1
    band = next_job(jobs, last)
    while band < last:
        first_tile, end_tile = bands[band] * tile_columns, bands[band + 1] * tile_columns
        positions = starts[first_tile:end_tile].copy()
        for rank in range(count):
            prefetch(buckets, BUCKET * np.intp(order[min(rank + _FAR, count - 1)]))
            ahead = order[min(rank + _NEAR, count - 1)]
            prefetch(tile_of_slot, np.intp(buckets[ahead, FIRST_SLOT]))
            j = order[rank]
            if buckets[j, LAST_ROW] < bands[band] or buckets[j, FIRST_ROW] >= bands[band + 1]:
                continue
            first_slot = np.intp(buckets[j, FIRST_SLOT])
            for slot in range(first_slot, first_slot + buckets[j, SLOTS]):
                tile = np.intp(tile_of_slot[slot])
                if first_tile <= tile < end_tile:
                    entry = positions[tile - first_tile]
                    positions[tile - first_tile] = entry + 1
                    entries[entry, 0] = j
                    entries[entry, 1] = slot
        band = next_job(jobs, last)

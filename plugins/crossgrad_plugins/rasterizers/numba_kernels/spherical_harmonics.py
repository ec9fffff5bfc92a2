"""View-dependent colour from real spherical harmonics (SH) up to degree 3."""

import math

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jobs import Jobs, next_job
from crossgrad_core.numerics.simd import WIDE, aligned, prefetch
from crossgrad_plugins.rasterizers.numba_kernels.basis import (
    BASIS,
    C0,
    FLOATS,
    HIGHER,
    TABLE,
    WAYS,
    basis_of,
    normalize,
    pull_ways,
    put_way,
    rest_basis_gradients,
    spread,
    sum_up,
    turned,
)
from crossgrad_plugins.rasterizers.numba_kernels.jit import device, kernel
from crossgrad_plugins.rasterizers.numba_kernels.layout import (
    CHUNK,
    LOG_OPACITY,
    RECORD,
    RED,
)

#: Number of floats in a cache line.
_LINE = 16
#: Number of Gaussians whose basis functions are computed before the first one is used. Coefficients
#: are also prefetched for Gaussians this far ahead.
_BLOCK = WIDE


@device
def _bring_near(rest: NDArray[np.float32], i: int) -> None:
    """Prefetch the SH coefficients of Gaussian i into the cache."""
    width = 3 * rest.shape[1]
    for at in range(0, width, _LINE):
        prefetch(rest, i * width + at)


@device
def _look(
    degree: int,
    eye: NDArray[np.float64],
    means: NDArray[np.float32],
    owners: NDArray[np.int32],
    first: int,
    last: int,
    ways: NDArray[np.float64],
    table: NDArray[np.float32],
    bases: NDArray[np.float32],
) -> None:
    """Write the unit vectors, inverse distances and basis functions of a block of Gaussians."""
    for j in range(last - first):
        put_way(means, np.intp(owners[first + j]), eye, ways, j)
    normalize(ways)
    basis_of(degree, ways, table)
    turned(table, bases)


@kernel
def sh_forward(
    jobs: Jobs,
    degree: int,
    eye: NDArray[np.float64],
    means: NDArray[np.float32],
    dc: NDArray[np.float32],
    rest: NDArray[np.float32],
    drawn: NDArray[np.int64],
    owners: NDArray[np.int32],
    records: NDArray[np.float32],
    radii: NDArray[np.int32],
) -> None:
    """Write max(0, 1/2 + SH(direction)) to the colours of the records.

    Args:
        jobs: Work queue from `share`.
        degree: Active SH degree, 0 to 3.
        eye: [3] camera centre.
        means: [N, 3] centres.
        dc: [N, 1, 3] SH coefficients of degree 0.
        rest: [N, B - 1, 3] SH coefficients of higher degrees; only active degrees are read.
        drawn: [chunks] number of records of each chunk, from `project`.
        owners: [N] Gaussian of each record, from `project`.
        records: The records, flat; their colours are written. A record with a non-finite colour is
            not drawn.
        radii: [N] radii; set to 0 for records with a non-finite colour.
    """
    count = (degree + 1) * (degree + 1)
    whole = count == BASIS and rest.shape[1] == HIGHER
    ways, table = np.ones(WAYS, np.float64), aligned(TABLE)
    bases, colours = aligned(TABLE), aligned(TABLE)
    table[:] = np.float32(0.0)
    chunks = drawn.shape[0]
    chunk = next_job(jobs, chunks)
    while chunk < chunks:
        end = chunk * CHUNK + drawn[chunk]
        for first in range(chunk * CHUNK, end, _BLOCK):
            last = min(first + _BLOCK, end)
            _look(degree, eye, means, owners, first, last, ways, table, bases)
            for j in range(first, last):
                _bring_near(rest, np.intp(owners[min(j + _BLOCK, end - 1)]))
                i, row = np.intp(owners[j]), (j - first) * BASIS
                if whole:
                    sum_up(bases, row, rest, i * FLOATS, colours)
                    continue
                colours[row : row + 3] = np.float32(0.0)
                for k in range(1, count):
                    for channel in range(3):
                        colours[row + channel] += bases[row + k] * rest[i, k - 1, channel]
            for j in range(first, last):
                i, row = np.intp(owners[j]), (j - first) * BASIS
                for channel in range(3):
                    colour = 0.5 + C0 * np.float64(dc[i, 0, channel])
                    colour += np.float64(colours[row + channel])
                    if not math.isfinite(colour):
                        # Change the record so that the Gaussian touches no pixel.
                        records[j * RECORD + LOG_OPACITY] = -math.inf
                        radii[i] = 0
                    records[j * RECORD + RED + channel] = max(colour, 0.0)
        chunk = next_job(jobs, chunks)


@kernel
def sh_backward(
    jobs: Jobs,
    degree: int,
    eye: NDArray[np.float64],
    means: NDArray[np.float32],
    rest: NDArray[np.float32],
    drawn: NDArray[np.int64],
    owners: NDArray[np.int32],
    records: NDArray[np.float32],
    v_colors: NDArray[np.float32],
    v_dc: NDArray[np.float32],
    v_rest: NDArray[np.float32],
    v_means: NDArray[np.float32],
    wanted: tuple[bool, bool, bool],
) -> None:
    """Convert gradients with respect to colours to gradients of coefficients and centres.

    Args:
        jobs: Work queue from `share`.
        degree: Active SH degree, 0 to 3.
        eye: [3] camera centre.
        means: [N, 3] centres.
        rest: [N, B - 1, 3] SH coefficients of higher degrees.
        drawn: [chunks] number of records of each chunk.
        owners: [N] Gaussian of each record.
        records: The records, flat.
        v_colors: [N, 3] gradients with respect to the clamped colours.
        v_dc: [N, 1, 3] output for the drawn Gaussians; must be zero at the start.
        v_rest: [N, B - 1, 3] output like `v_dc`, only for active degrees; it has no rows if it is
            not needed.
        v_means: [N, 3] gradients to which the gradients of the centres are added.
        wanted: Two flags. The first flag is True if `v_dc` and `v_rest` have one row per record, in
            the order of the records. Such rows are written completely and need not be zero at the
            start. The second flag is True if `v_rest` is needed.
    """
    dc_by_rows, rest_by_rows, learns = wanted
    count = (degree + 1) * (degree + 1)
    whole = count == BASIS and rest.shape[1] == HIGHER
    ways, table = np.ones(WAYS, np.float64), aligned(TABLE)
    bases, v_rgb, v_bases = aligned(TABLE), aligned(TABLE), aligned(TABLE)
    table[:] = v_rgb[:] = v_bases[:] = np.float32(0.0)
    chunks = drawn.shape[0]
    chunk = next_job(jobs, chunks)
    while chunk < chunks:
        before = drawn[:chunk].sum() - chunk * CHUNK
        end = chunk * CHUNK + drawn[chunk]
        for first in range(chunk * CHUNK, end, _BLOCK):
            last = min(first + _BLOCK, end)
            _look(degree, eye, means, owners, first, last, ways, table, bases)
            for j in range(first, last):
                i, row = np.intp(owners[j]), (j - first) * BASIS
                to_dc = before + j if dc_by_rows else i
                seen = records[j * RECORD + LOG_OPACITY] > -math.inf
                for channel in range(3):
                    # A channel that is clamped to 0 has no gradient.
                    free = seen and records[j * RECORD + RED + channel] > np.float32(0.0)
                    v = v_colors[i, channel] if free else np.float32(0.0)
                    v_rgb[row + channel] = v
                    v_dc[to_dc, 0, channel] = C0 * np.float64(v)
            for j in range(first, last):
                _bring_near(rest, np.intp(owners[min(j + _BLOCK, end - 1)]))
                i, row = np.intp(owners[j]), (j - first) * BASIS
                to_rest = before + j if rest_by_rows else i
                if whole:
                    if learns:
                        spread(bases, row, v_rgb, v_rest, to_rest * FLOATS)
                    rest_basis_gradients(v_rgb, row, rest, i * FLOATS, v_bases)
                    continue
                if learns and rest_by_rows:
                    v_rest[to_rest] = np.float32(0.0)
                for k in range(1, count):
                    along = np.float32(0.0)
                    for channel in range(3):
                        if learns:
                            v_rest[to_rest, k - 1, channel] = v_rgb[row + channel] * bases[row + k]
                        along += v_rgb[row + channel] * rest[i, k - 1, channel]
                    v_bases[row + k - 1] = along
            turned(v_bases, table)
            pull_ways(degree, table, ways)
            for j in range(first, last):
                if records[j * RECORD + LOG_OPACITY] == -math.inf:
                    continue
                i = np.intp(owners[j])
                for axis in range(3):
                    v_means[i, axis] += ways[j - first + axis * WIDE]
        chunk = next_job(jobs, chunks)

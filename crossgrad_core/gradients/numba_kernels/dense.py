"""Kernels for the float32 gradients of K views: Gramians, weighted sums, overlaps of gradients.

Gradients are passed by their memory addresses. `addresses` [T, K] int64 contains the address of
view k's gradient of tensor t, or 0 if the view does not touch the tensor. `sizes` [T] contains the
number of elements of each tensor. The work is split into chunks of `CHUNK` elements. Partial sums
are added in the order of the chunks, for any number of threads. The same gradients therefore give
bit-identical results with any number of threads.
"""

from typing import Any

import numpy as np
from numba import carray  # type: ignore[attr-defined]
from numpy.typing import NDArray

from crossgrad_core.gradients.numba_kernels.dots import dots_1, dots_2, dots_2x2, dots_3, dots_4
from crossgrad_core.gradients.numba_kernels.pointers import float32_pointer
from crossgrad_core.numerics.jit import strict_device, strict_kernel
from crossgrad_core.numerics.jobs import Jobs, next_job

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Rows = NDArray[np.float32]

#: Number of elements in a chunk. A chunk of one view has 64 kB. The chunks of sixteen views fit
#: together into the L2 cache.
CHUNK = 16384
#: Number of elements for which a weighted sum is computed at a time.
PIECE = 1024


@strict_kernel
def chunk_table(sizes: Ints) -> Ints:
    """Return [C, 2]: for each chunk, its tensor and the position of its first element."""
    total = 0
    for size in sizes:
        total += (size + CHUNK - 1) // CHUNK
    table = np.empty((total, 2), np.int64)
    c = 0
    for t in range(sizes.size):
        for start in range(0, sizes[t], CHUNK):
            table[c, 0] = t
            table[c, 1] = start
            c += 1
    return table


@strict_device
def row(address: int, start: int, length: int) -> NDArray[np.float32]:
    """Return `length` elements of the tensor at `address`, from element `start` on."""
    pointer: Any = float32_pointer(address + 4 * start)  # type: ignore[call-arg]
    return carray(pointer, (length,))


@strict_device
def _many_dots(rows: Ints, count: int, start: int, length: int, out: Floats) -> None:
    """Compute the Gramian of more than four rows in tiles of 2 x 2.

    The data of the chunk stay in the cache.
    """
    tile = np.empty((2, 2))
    for i in range(0, count, 2):
        i1 = min(i + 1, count - 1)
        a, b = row(rows[i], start, length), row(rows[i1], start, length)
        dots_2(a, b, tile)
        out[i, i], out[i1, i1] = tile[0, 0], tile[1, 1]
        if i1 > i:
            out[i, i1] = tile[0, 1]
        for j in range(i + 2, count, 2):
            j1 = min(j + 1, count - 1)
            dots_2x2(a, b, row(rows[j], start, length), row(rows[j1], start, length), tile)
            out[i, j], out[i1, j] = tile[0, 0], tile[1, 0]
            out[i, j1], out[i1, j1] = tile[0, 1], tile[1, 1]


@strict_device
def _chunk_gramian(addresses: Ints, start: int, length: int, compact: Floats, out: Floats) -> None:
    """Compute the upper triangle of the Gramian of one chunk.

    Entries of views without a gradient stay zero.
    """
    views = addresses.size
    rows = np.empty(views, np.int64)
    places = np.empty(views, np.int64)
    count = 0
    for k in range(views):
        if addresses[k] != 0:
            rows[count] = addresses[k]
            places[count] = k
            count += 1
    if count == 0:
        return
    a = row(rows[0], start, length)
    if count == 1:
        dots_1(a, compact)
    elif count == 2:
        dots_2(a, row(rows[1], start, length), compact)
    elif count == 3:
        dots_3(a, row(rows[1], start, length), row(rows[2], start, length), compact)
    elif count == 4:
        b, c = row(rows[1], start, length), row(rows[2], start, length)
        dots_4(a, b, c, row(rows[3], start, length), compact)
    else:
        _many_dots(rows, count, start, length, compact)
    for i in range(count):
        for j in range(i, count):
            out[places[i], places[j]] = compact[i, j]


@strict_kernel
def summed(partial: Floats, table: Ints, tensors: int) -> Floats:
    """Return [T, K, K], the sums of the chunks' Gramians with Neumaier compensation.

    The sums contain both triangles.

    Args:
        partial: [C, K, K] Gramians of the chunks, upper triangles only.
        table: [C, 1 or more]; the first column contains the tensor of each chunk.
        tensors: Number of tensors T.
    """
    views = partial.shape[1]
    total = np.zeros((tensors, views, views))
    lost = np.zeros((tensors, views, views))
    for c in range(partial.shape[0]):
        t = table[c, 0]
        for i in range(views):
            for j in range(i, views):
                old, x = total[t, i, j], partial[c, i, j]
                new = old + x
                larger, smaller = (old, x) if abs(old) >= abs(x) else (x, old)
                lost[t, i, j] += (larger - new) + smaller
                total[t, i, j] = new
    for t in range(tensors):
        for i in range(views):
            for j in range(i, views):
                total[t, i, j] += lost[t, i, j]
                total[t, j, i] = total[t, i, j]
    return total


@strict_kernel
def gramians(jobs: Jobs, addresses: Ints, sizes: Ints, table: Ints, partial: Floats) -> None:
    """Write the Gramian of each chunk in one pass.

    Entries of a view with a non-finite gradient are NaN or infinite.

    Args:
        jobs: Job counters, passed by `parallel` or `serial`.
        addresses: [T, K] addresses of the gradients.
        sizes: [T] number of elements of each tensor.
        table: [C, 2], from `chunk_table`.
        partial: [C, K, K] output, filled with zeros before the call; `summed` adds these Gramians.
    """
    compact = np.empty(partial.shape[1:])
    chunks = table.shape[0]
    c = next_job(jobs, chunks)
    while c < chunks:
        t, start = table[c, 0], table[c, 1]
        _chunk_gramian(addresses[t], start, min(CHUNK, sizes[t] - start), compact, partial[c])
        c = next_job(jobs, chunks)


@strict_device
def _spread(addresses: Ints, rows: Ints, width: int, start: int, length: int, dense: Rows) -> bool:
    """Fill `dense` [K * CHUNK] with the elements of one chunk for each view.

    Return False if the chunk contains no sparse row.
    """
    first = np.searchsorted(rows, start // width)
    end = np.searchsorted(rows, (start + length - 1) // width + 1)
    if first == end:
        return False
    dense[:] = np.float32(0.0)
    for k in range(addresses.size):
        if addresses[k] == 0:
            continue
        values = row(addresses[k], first * width, (end - first) * width)
        for r in range(first, end):
            at = rows[r] * width - start
            for i in range(max(0, -at), min(width, length - at)):
                dense[k * CHUNK + at + i] = values[(r - first) * width + i]
    return True


@strict_kernel
def spread_gramian(
    jobs: Jobs, addresses: Ints, rows: Ints, width: int, size: int, partial: Floats
) -> None:
    """Write the Gramians of gradients that are zero except in some rows.

    The results are bit-identical to the results of `gramians`.

    Args:
        jobs: Job counters, passed by `parallel`.
        addresses: [K] addresses of the values [R * width]; 0 if the view does not touch the tensor.
        rows: [R] row numbers, sorted.
        width: Number of elements in a row.
        size: Number of elements in the tensor.
        partial: [C, K, K] output for the C chunks of the tensor, filled with zeros before the call.
    """
    views = addresses.size
    dense, compact = np.empty(views * CHUNK, np.float32), np.empty((views, views))
    chunks = partial.shape[0]
    c = next_job(jobs, chunks)
    while c < chunks:
        length = min(CHUNK, size - c * CHUNK)
        if _spread(addresses, rows, width, c * CHUNK, length, dense):
            places = np.zeros(views, np.int64)
            for k in range(views):
                if addresses[k] != 0:
                    places[k] = dense.ctypes.data + 4 * k * CHUNK
            _chunk_gramian(places, 0, length, compact, partial[c])
            # Numba frees an array after the last line that names the array. The assignment keeps
            # `dense` alive while its address is used.
            dense[0] = np.float32(0.0)
        c = next_job(jobs, chunks)


@strict_device
def _weighted(
    rows: Ints, weights: Floats, count: int, start: int, wide: Floats, narrow: Rows
) -> None:
    """Fill `narrow` with the weighted sum of rows, which is rounded to float32 once.

    In float64, the weights and products neither overflow nor underflow.
    """
    n = narrow.size
    a, u = row(rows[0], start, n), weights[0]
    if count == 1:
        for i in range(n):
            narrow[i] = np.float32(u * np.float64(a[i]))
        return
    b, v = row(rows[1], start, n), weights[1]
    if count == 2:
        for i in range(n):
            narrow[i] = np.float32(u * np.float64(a[i]) + v * np.float64(b[i]))
        return
    c, w = row(rows[2], start, n), weights[2]
    if count == 3:
        for i in range(n):
            x = u * np.float64(a[i]) + v * np.float64(b[i])
            narrow[i] = np.float32(x + w * np.float64(c[i]))
        return
    d, z = row(rows[3], start, n), weights[3]
    if count == 4:
        for i in range(n):
            x = u * np.float64(a[i]) + v * np.float64(b[i])
            narrow[i] = np.float32((x + w * np.float64(c[i])) + z * np.float64(d[i]))
        return
    for i in range(n):
        x = u * np.float64(a[i]) + v * np.float64(b[i])
        wide[i] = (x + w * np.float64(c[i])) + z * np.float64(d[i])
    for k in range(4, count):
        e, s = row(rows[k], start, n), weights[k]
        for i in range(n):
            wide[i] += s * np.float64(e[i])
    for i in range(n):
        narrow[i] = np.float32(wide[i])


@strict_device
def _divide(a: Rows, divisor: float) -> None:
    d = np.float32(divisor)
    for i in range(a.size):
        a[i] /= d


@strict_device
def _plain(rows: Ints, count: int, divisor: float, start: int, narrow: Rows) -> None:
    """Fill `narrow` with the sum of the rows, added in order in float32.

    After the addition, divide the sum by the divisor.
    """
    n = narrow.size
    a = row(rows[0], start, n)
    if count == 1:
        for i in range(n):
            narrow[i] = a[i]
    else:
        b = row(rows[1], start, n)
        for i in range(n):
            narrow[i] = a[i] + b[i]
    for k in range(2, count):
        c = row(rows[k], start, n)
        for i in range(n):
            narrow[i] += c[i]
    if divisor != 1.0:
        _divide(narrow, divisor)


@strict_device
def _weighted_into(a: Rows, u: float, b: Rows, v: float) -> None:
    for i in range(a.size):
        a[i] = np.float32(u * np.float64(a[i]) + v * np.float64(b[i]))


@strict_device
def _plain_into(a: Rows, b: Rows, divisor: float) -> None:
    if divisor == 1.0:
        for i in range(a.size):
            a[i] += b[i]
    else:
        d = np.float32(divisor)
        for i in range(a.size):
            a[i] = (a[i] + b[i]) / d


@strict_device
def _combine_pieces(
    rows: Ints,
    weights: Floats,
    count: int,
    plain: bool,
    divisor: float,
    out: int,
    first: int,
    end: int,
) -> None:
    """Compute the results in a small buffer, because they may overwrite a view's gradient."""
    wide = np.empty(PIECE)
    narrow = np.empty(PIECE, np.float32)
    for start in range(first, end, PIECE):
        length = min(PIECE, end - start)
        if plain:
            _plain(rows, count, divisor, start, narrow[:length])
        else:
            _weighted(rows, weights, count, start, wide[:length], narrow[:length])
        result = row(out, start, length)
        for i in range(length):
            result[i] = narrow[i]


@strict_device
def _combine_chunk(
    addresses: Ints, weights: Floats, plain: bool, divisor: float, out: int, first: int, end: int
) -> None:
    views = addresses.size
    rows = np.empty(views, np.int64)
    used = np.empty(views)
    count = 0
    for k in range(views):
        if addresses[k] != 0:
            rows[count] = addresses[k]
            used[count] = weights[k]
            count += 1
    if count == 0:
        result = row(out, first, end - first)
        for i in range(result.size):
            result[i] = 0.0
    elif count == 2 and (out == rows[0] or out == rows[1]):
        # The most common situation: two views, and the result overwrites the gradient of one view.
        # The order of two summands does not change the sum.
        this = 0 if out == rows[0] else 1
        a, b = row(out, first, end - first), row(rows[1 - this], first, end - first)
        if plain:
            _plain_into(a, b, divisor)
        else:
            _weighted_into(a, used[this], b, used[1 - this])
    else:
        _combine_pieces(rows, used, count, plain, divisor, out, first, end)


@strict_kernel
def combine(
    jobs: Jobs,
    addresses: Ints,
    weights: Floats,
    plain: Flags,
    divisor: float,
    out: Ints,
    sizes: Ints,
    table: Ints,
) -> None:
    """Write the weighted sums for all tensors, in one pass over the gradients of all views.

    Args:
        jobs: Job counters, passed by `parallel` or `serial`.
        addresses: [T, K] addresses of the gradients; 0 leaves a view out.
        weights: [T, K] weight of each gradient.
        plain: [T], True for tensors whose gradients are added without weights, in float32 and in
            the order of the views.
        divisor: Number by which plain sums are divided, in float32.
        out: [T] addresses of the results. A result may overwrite the gradient of a view.
        sizes: [T] number of elements of each tensor.
        table: [C, 2], from `chunk_table`.
    """
    chunks = table.shape[0]
    c = next_job(jobs, chunks)
    while c < chunks:
        t, first = table[c, 0], table[c, 1]
        end = min(first + CHUNK, sizes[t])
        _combine_chunk(addresses[t], weights[t], plain[t], divisor, out[t], first, end)
        c = next_job(jobs, chunks)


@strict_kernel
def overlapping(a: int, b: int, size: int) -> bool:
    """Return True if some element is non-zero in both tensors."""
    x, y = row(a, 0, size), row(b, 0, size)
    for start in range(0, size, CHUNK):
        shared = 0
        for i in range(start, min(start + CHUNK, size)):
            shared |= (x[i] != 0) & (y[i] != 0)
        if shared:
            return True
    return False

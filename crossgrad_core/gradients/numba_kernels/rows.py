"""Gramians and weighted sums for each row: every primitive has its own small Gramian.

`addresses` and `sizes` have the meaning that `dense` describes. Row i of a tensor of width d starts
at element i * d.
"""

import numpy as np

from crossgrad_core.gradients.numba_kernels.dense import Flags, Floats, Ints, row
from crossgrad_core.numerics.jit import strict_device, strict_kernel
from crossgrad_core.numerics.jobs import Jobs, next_job

#: Number of rows in one job of the work queue.
ROWS = 2048


@strict_device
def _gramian_task(addresses: Ints, widths: Ints, first: int, end: int, out: Floats) -> None:
    tensors, views = addresses.shape
    for t in range(tensors):
        d = widths[t]
        for k in range(views):
            for other in range(k, views):
                if addresses[t, k] == 0 or addresses[t, other] == 0:
                    continue
                a = row(addresses[t, k], first * d, (end - first) * d)
                b = row(addresses[t, other], first * d, (end - first) * d)
                for i in range(end - first):
                    total = 0.0
                    for j in range(i * d, i * d + d):
                        total += np.float64(a[j]) * np.float64(b[j])
                    out[first + i, k, other] += total
    for i in range(first, end):
        for k in range(views):
            for other in range(k):
                out[i, k, other] = out[i, other, k]


@strict_kernel
def row_gramians(jobs: Jobs, addresses: Ints, widths: Ints, out: Floats) -> None:
    """For each row, add the Gramian over the T tensors of a block to `out`.

    Args:
        jobs: Job counters, passed by `parallel`.
        addresses: [T, K] addresses of the gradients; 0 if a view does not touch the tensor.
        widths: [T] number of elements in a row of each tensor.
        out: [N, K, K] float64 output, filled with zeros before the call.
    """
    count = out.shape[0]
    tasks = (count + ROWS - 1) // ROWS
    task = next_job(jobs, tasks)
    while task < tasks:
        _gramian_task(addresses, widths, task * ROWS, min(task * ROWS + ROWS, count), out)
        task = next_job(jobs, tasks)


@strict_device
def _combine_task(
    addresses: Ints, weights: Floats, out: int, width: int, first: int, end: int
) -> None:
    wide = np.zeros((end - first) * width)
    for k in range(addresses.size):
        if addresses[k] == 0:
            continue
        a = row(addresses[k], first * width, wide.size)
        for i in range(end - first):
            w = weights[first + i, k]
            if w != 0.0:
                for j in range(i * width, i * width + width):
                    wide[j] += w * np.float64(a[j])
    result = row(out, first * width, wide.size)
    for j in range(wide.size):
        result[j] = np.float32(wide[j])


@strict_kernel
def row_combine(jobs: Jobs, addresses: Ints, weights: Floats, out: int, width: int) -> None:
    """Write sum_k weights[i, k] * (row i of view k). A weight of 0 leaves a row out.

    Args:
        jobs: Job counters, passed by `parallel`.
        addresses: [K] addresses of the gradients; 0 leaves a view out.
        weights: [N, K] weight of each row of each view.
        out: Address of the result, which may be the address of a view's gradient.
        width: Number of elements in a row.
    """
    count = weights.shape[0]
    tasks = (count + ROWS - 1) // ROWS
    task = next_job(jobs, tasks)
    while task < tasks:
        end = min(task * ROWS + ROWS, count)
        _combine_task(addresses, weights, out, width, task * ROWS, end)
        task = next_job(jobs, tasks)


@strict_kernel
def row_overlaps(a: int, b: int, count: int, width: int, out: Flags) -> None:
    """Set out[i] to True if row i has an element that is non-zero in both tensors."""
    x, y = row(a, 0, count * width), row(b, 0, count * width)
    for i in range(count):
        for j in range(i * width, i * width + width):
            if x[j] != 0 and y[j] != 0:
                out[i] = True

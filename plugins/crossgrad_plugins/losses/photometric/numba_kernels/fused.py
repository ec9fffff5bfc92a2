"""The photometric loss and its gradient in one pass over the image (Numba, CPU, float32).

Let x be the image, y the target, s = x + y and d = x - y. With s and d, SSIM needs only four
windowed means (M_s, M_d, E[s^2], E[d^2]) instead of five. In this form, the factors do not subtract
values of the two images from each other:

    SSIM = (M_s^2 - M_d^2 + 2 C1) (V_s - V_d + 2 C2) / ((M_s^2 + M_d^2 + 2 C1) (V_s + V_d + 2 C2)),

with V = E[.^2] - M^2. The gradient is G * a + s (G * b) + d (G * c), with the derivatives a, b, c
with respect to M_s + M_d, V_s and V_d. G * is a convolution with the window of SSIM. In smooth
parts of an image, a variance is the difference of two nearly equal numbers. The kernel therefore
subtracts from s and d their means over the tile, per channel.

The image is divided into tiles whose size depends only on the size of the image. A tile is
processed row by row with ring buffers of sixteen rows, for s, d and mask, and for a, b and c. All
data of a tile therefore fit into the second-level cache, and memory does not grow with the image.
Every tile recomputes the rows around it, so that tiles are independent. The result then has the
same bits for any number of threads.
"""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.numerics.jit import kernel, part
from crossgrad_core.numerics.jobs import Jobs, next_job, parallel
from crossgrad_core.numerics.simd import aligned
from crossgrad_plugins.losses.photometric.numba_kernels.rows import (
    BACK,
    CHANNELS,
    DIFFERENCE,
    HALO,
    LINE,
    PARTIAL,
    SCRATCH,
    SLOTS,
    STRIDE,
    TILE_COLUMNS,
    TILE_ROWS,
    copy,
    load_row,
    set_centres,
)
from crossgrad_plugins.losses.photometric.numba_kernels.terms import (
    clear_row,
    gradient_row,
    ssim_row,
    sum_absolute,
    sum_gradient_rows,
    sum_of,
    sum_rows,
)
from crossgrad_plugins.losses.photometric.reference import RADIUS

_Floats: TypeAlias = NDArray[np.float32]
_Bytes: TypeAlias = NDArray[np.uint8]
_Flags: TypeAlias = NDArray[np.bool_]
_Box: TypeAlias = tuple[int, int, int, int]  # first row, end row, first column, end column


@part
def _tile(
    scratch: _Floats, image: _Floats, target: _Floats, target_8bit: _Bytes, is_8bit: bool,
    mask: _Flags, is_masked: bool, gradient: _Floats, with_gradient: bool,
    box: _Box, height: int, width: int, l1_weight: np.float32, ssim_weight: np.float32,
) -> tuple[float, float]:  # fmt: skip
    """Return the sums of |x - y| and 1 - SSIM over a tile, and write the gradient."""
    top, bottom, left, right = box
    columns = right - left
    halo = RADIUS if with_gradient else 0
    absolute, dissimilarity = 0.0, 0.0
    set_centres(scratch, image, target, target_8bit, is_8bit, mask, is_masked, box, width)
    loaded = top - halo - RADIUS
    # Rows are processed in pairs. If the number of rows is odd, the second row of the last pair is
    # not used.
    for first in range(top - halo, bottom + halo, 2):
        while loaded <= first + 1 + RADIUS:
            load_row(
                scratch, image, target, target_8bit, is_8bit, mask, is_masked, loaded, box,
                height, width,
            )  # fmt: skip
            loaded += 1
        sum_rows(scratch, first, columns)
        for row in range(first, min(first + 2, bottom + halo)):
            if 0 <= row < height:
                ssim_row(scratch, row, columns, PARTIAL + (row - first) * 4 * STRIDE)
            else:
                clear_row(scratch, row, columns)
            if top <= row < bottom:
                dissimilarity += sum_of(scratch, LINE + HALO, CHANNELS * columns)
                slot = DIFFERENCE + (row & (SLOTS - 1)) * STRIDE + 2 * HALO
                absolute += sum_absolute(scratch, slot, CHANNELS * columns)
        ready = first - RADIUS
        if with_gradient and ready >= top:
            sum_gradient_rows(scratch, ready, columns)
            for row in range(ready, min(ready + 2, bottom)):
                back = BACK + (row - ready) * 3 * STRIDE
                gradient_row(scratch, row, columns, back, l1_weight, ssim_weight)
                destination = (row * width + left) * CHANNELS
                copy(gradient, destination, scratch, LINE, CHANNELS * columns)
    return absolute, dissimilarity


@kernel
def _all_tiles(
    jobs: Jobs, image: _Floats, target: _Floats, target_8bit: _Bytes, is_8bit: bool,
    mask: _Flags, is_masked: bool, gradient: _Floats, with_gradient: bool,
    height: int, width: int, l1_weight: np.float32, ssim_weight: np.float32,
    sums: NDArray[np.float64],
) -> None:  # fmt: skip
    """Process every tile, and write the sums [rows of tiles, columns of tiles, 2]."""
    down, across = sums.shape[0], sums.shape[1]
    rows, columns = (height + down - 1) // down, (width + across - 1) // across
    tiles = down * across
    tile = next_job(jobs, tiles)
    if tile >= tiles:
        return
    scratch = aligned(SCRATCH)
    scratch[:] = np.float32(0.0)
    while tile < tiles:
        top, left = tile // across * rows, tile % across * columns
        box = (top, min(height, top + rows), left, min(width, left + columns))
        if box[0] < box[1] and box[2] < box[3]:
            absolute, dissimilarity = _tile(
                scratch, image, target, target_8bit, is_8bit, mask, is_masked, gradient,
                with_gradient, box, height, width, l1_weight, ssim_weight,
            )  # fmt: skip
            sums[tile // across, tile % across, 0] = absolute
            sums[tile // across, tile % across, 1] = dissimilarity
        tile = next_job(jobs, tiles)


def loss_terms(
    image: NDArray[np.float32],
    target: NDArray[np.float32] | NDArray[np.uint8],
    mask: NDArray[np.bool_] | None = None,
    gradient: NDArray[np.float32] | None = None,
    ssim_weight: float = 0.2,
) -> tuple[float, float]:
    """Return the means of |x - y| and of 1 - SSIM over unmasked pixels, and write the gradient.

    Args:
        image: [H, W, 3] the render, C-contiguous.
        target: [H, W, 3] the photo, C-contiguous; 8-bit values are divided by 255.
        mask: [H, W] True for pixels that count; None if all pixels count.
        gradient: [H, W, 3] C-contiguous output: the gradient of (1 - w) * L1 + w * (1 - SSIM); if
            None, the gradient is not computed.
        ssim_weight: The weight w.

    Returns: L1 and 1 - SSIM; both are 0 if no pixel counts.
    """
    height, width, _ = image.shape
    kept = height * width if mask is None else int(np.count_nonzero(mask))
    if kept == 0:
        if gradient is not None:
            gradient.fill(0)
        return 0.0, 0.0
    count = kept * CHANNELS
    down, across = -(-height // TILE_ROWS), -(-width // TILE_COLUMNS)
    sums = np.zeros((down, across, 2))
    is_8bit = target.dtype == np.uint8
    parallel(
        _all_tiles,
        image.reshape(-1),
        np.empty(0, np.float32) if is_8bit else target.reshape(-1).view(np.float32),
        target.reshape(-1).view(np.uint8) if is_8bit else np.empty(0, np.uint8),
        is_8bit,
        np.empty(0, np.bool_) if mask is None else mask.reshape(-1),
        mask is not None,
        np.empty(0, np.float32) if gradient is None else gradient.reshape(-1),
        gradient is not None,
        height,
        width,
        np.float32((1 - ssim_weight) / count),
        np.float32(ssim_weight / count),
        sums,
    )
    absolute, dissimilarity = sums.sum(axis=(0, 1)) / count
    return float(absolute), float(dissimilarity)

"""Blocks: rows of BLOCK float64 numbers in one flat vector; number k of each row is for Gaussian k.

LLVM vectorises branch-free loops over k only if it knows that rows do not overlap. Therefore a
block is one vector with rows at constant distances.
"""

import numpy as np
from numpy.typing import NDArray

from crossgrad_plugins.rasterizers.numba_kernels.ewa import Row, Triple
from crossgrad_plugins.rasterizers.numba_kernels.jit import device

#: Number of Gaussians in a block. CHUNK is a multiple of this number.
BLOCK = 128


@device
def get(block: NDArray[np.float64], row: int, k: int) -> float:
    """Return number k of a row."""
    return block[row * BLOCK + k]


@device
def get_three(block: NDArray[np.float64], row: int, k: int) -> Triple:
    """Return number k of three rows."""
    at = row * BLOCK + k
    return block[at], block[at + BLOCK], block[at + 2 * BLOCK]


@device
def get_four(block: NDArray[np.float64], row: int, k: int) -> Row:
    """Return number k of four rows."""
    at = row * BLOCK + k
    return block[at], block[at + BLOCK], block[at + 2 * BLOCK], block[at + 3 * BLOCK]


@device
def put(block: NDArray[np.float64], row: int, k: int, value: float) -> None:
    """Write number k of a row."""
    block[row * BLOCK + k] = value


@device
def put_three(block: NDArray[np.float64], row: int, k: int, values: Triple) -> None:
    """Write number k of three rows."""
    at = row * BLOCK + k
    block[at] = values[0]
    block[at + BLOCK] = values[1]
    block[at + 2 * BLOCK] = values[2]


@device
def put_four(block: NDArray[np.float64], row: int, k: int, values: Row) -> None:
    """Write number k of four rows."""
    at = row * BLOCK + k
    block[at] = values[0]
    block[at + BLOCK] = values[1]
    block[at + 2 * BLOCK] = values[2]
    block[at + 3 * BLOCK] = values[3]

"""Blocks of float64 numbers in one flat vector.

A block has rows of BLOCK numbers, and number k of each row belongs to Gaussian k. LLVM vectorises
loops over k only if they have no branches and if it knows that rows do not overlap. A block is
therefore one vector, whose rows start at constant distances.
"""

import numpy as np
from numpy.typing import NDArray

from crossgrad_plugins.rasterizers.numba_kernels.ewa import Row, Triple
from crossgrad_plugins.rasterizers.numba_kernels.jit import device

#: Number of Gaussians in a block. CHUNK must be a multiple of this number.
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

"""Blocks: rows of BLOCK float64 numbers in one flat vector, number k of each for Gaussian k.

Loops over k without branches are vectorised by LLVM, which must see that rows do not overlap:
one vector, rows at constant distances.
"""

import numpy as np
from numpy.typing import NDArray

from crossgrad_plugins.rasterizers.numba_kernels.ewa import Row, Triple
from crossgrad_plugins.rasterizers.numba_kernels.jit import device

#: Gaussians of a block; divides CHUNK.
BLOCK = 128


@device
def get(block: NDArray[np.float64], row: int, k: int) -> float:
    """Returns number k of a row."""
    return block[row * BLOCK + k]


@device
def get_three(block: NDArray[np.float64], row: int, k: int) -> Triple:
    """Returns number k of three rows."""
    at = row * BLOCK + k
    return block[at], block[at + BLOCK], block[at + 2 * BLOCK]


@device
def get_four(block: NDArray[np.float64], row: int, k: int) -> Row:
    """Returns number k of four rows."""
    at = row * BLOCK + k
    return block[at], block[at + BLOCK], block[at + 2 * BLOCK], block[at + 3 * BLOCK]


@device
def put(block: NDArray[np.float64], row: int, k: int, value: float) -> None:
    """Writes number k of a row."""
    block[row * BLOCK + k] = value


@device
def put_three(block: NDArray[np.float64], row: int, k: int, values: Triple) -> None:
    """Writes number k of three rows."""
    at = row * BLOCK + k
    block[at] = values[0]
    block[at + BLOCK] = values[1]
    block[at + 2 * BLOCK] = values[2]


@device
def put_four(block: NDArray[np.float64], row: int, k: int, values: Row) -> None:
    """Writes number k of four rows."""
    at = row * BLOCK + k
    block[at] = values[0]
    block[at + BLOCK] = values[1]
    block[at + 2 * BLOCK] = values[2]
    block[at + 3 * BLOCK] = values[3]

"""Which passes take which columns."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_core.gradients import generic, native
from crossgrad_core.gradients.columns import Column, is_native


class Passes(Protocol):
    """The passes over single columns that both modules offer; see `generic`."""

    def overlap(self, column: Column, first: int, second: int) -> bool:
        """Whether two views share a non-zero element's place."""

    def row_gramians(self, columns: Sequence[Column], rows: int) -> NDArray[np.float64]:
        """[rows, K, K] Gramians of each row."""

    def row_overlap(
        self, column: Column, first: int, second: int, rows: int, shared: NDArray[np.bool_]
    ) -> None:
        """Marks rows in which two views share a non-zero element's place."""

    def row_combine(self, column: Column, weights: NDArray[np.float64], out: Tensor) -> None:
        """Writes the weighted sums of each row, by weights [rows, K]."""


def passes_of(*columns: Column) -> Passes:
    """The compiled passes where they take all of the columns, else those of torch."""
    return native if all(map(is_native, columns)) else generic

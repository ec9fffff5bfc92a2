"""One input of the suite: K gradients, short enough to be exact about or repeating themselves."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Rows = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Case:
    """K gradients of P = H + R * Q elements: a head, then R copies of a pattern.

    Whatever is linear in the elements, as Gramians are, then has a closed form however large P is.

    Attributes:
        name: Shown in the table.
        head: [K, H] float64.
        pattern: [K, Q] float64.
        copies: R.
        dtype: Type of the gradients; head and pattern are rounded to it.
        absent: Views that do not touch the block.
    """

    name: str
    head: Rows
    pattern: Rows
    copies: int = 0
    dtype: torch.dtype = torch.float32
    absent: frozenset[int] = frozenset()

    @property
    def views(self) -> int:
        """K."""
        return len(self.head)

    @property
    def size(self) -> int:
        """P."""
        return int(self.head.shape[1] + self.copies * self.pattern.shape[1])

    @cached_property
    def exact_head(self) -> Rows:
        """[K, H] the head as the operator gets it: rounded, zero where absent."""
        return self._rounded(self.head)

    @cached_property
    def exact_pattern(self) -> Rows:
        """[K, Q] the pattern as the operator gets it: rounded, zero where absent."""
        return self._rounded(self.pattern)

    def gradients(self) -> list[Tensor | None]:
        """The K gradients, made afresh."""
        head = torch.from_numpy(self.exact_head).to(self.dtype)
        pattern = torch.from_numpy(self.exact_pattern).to(self.dtype)
        return [
            None if k in self.absent else torch.cat([head[k], pattern[k].repeat(self.copies)])
            for k in range(self.views)
        ]

    def _rounded(self, rows: Rows) -> Rows:
        rounded = torch.from_numpy(rows).to(self.dtype).double().numpy().copy()
        rounded[sorted(self.absent)] = 0.0
        return rounded


def short(
    name: str,
    rows: object,
    dtype: torch.dtype = torch.float32,
    absent: frozenset[int] = frozenset(),
) -> Case:
    """A case without repetition; `rows` is [K, P]."""
    head = np.asarray(rows, np.float64)
    return Case(name, head, np.zeros((len(head), 0)), 0, dtype, absent)

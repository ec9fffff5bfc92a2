"""A small part of all combinations in which every two components meet."""

from collections.abc import Iterable, Sequence
from itertools import combinations
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from crossgrad_plugins.authoring.matrix.combinations import Row

#: (first factor, second factor, value of the first, value of the second).
Pair: TypeAlias = tuple[int, int, str, str]


def pairs_of(row: Row) -> list[Pair]:
    """Every two values of a row, with the factors that they belong to."""
    return [(i, j, row[i], row[j]) for i, j in combinations(range(len(row)), 2)]


def pairwise(admitted: Iterable[Row]) -> list[Row]:
    """A small part of the admitted rows in which every pair of values occurs that occurs in any.

    Takes the row with the most new pairs until none is left, the first of several: the same rows
    in the same order give the same design. Never larger than the number of pairs.

    Args:
        admitted: Rows of one length; those that cannot work are simply not among them.
    """
    rows = list(admitted)
    if not rows:
        return []
    numbers = _numbered(rows)
    missing = np.ones(int(numbers.max()) + 1, np.bool_)
    chosen = []
    while missing.any():
        best = int(missing[numbers].sum(axis=1).argmax())
        missing[numbers[best]] = False
        chosen.append(rows[best])
    return chosen


def _numbered(rows: Sequence[Row]) -> NDArray[np.int64]:
    """[rows, pairs per row] a number for each different pair."""
    known: dict[Pair, int] = {}
    return np.array([[known.setdefault(p, len(known)) for p in pairs_of(row)] for row in rows])

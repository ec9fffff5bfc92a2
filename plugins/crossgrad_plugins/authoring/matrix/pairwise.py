"""Few cases that still bring every two components together."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import combinations
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

#: One value per factor.
Row: TypeAlias = tuple[str, ...]
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


def meetings(
    place: int,
    value: str,
    values: Sequence[Sequence[str]],
    usual: Callable[[Mapping[int, str]], Row],
    admits: Callable[[Row], bool],
) -> Iterator[Row]:
    """Few admitted rows in which one value meets every value of the other factors.

    The values of all factors come in turn first. Those that such a row did not admit are tried with
    the usual values of the other factors, of which one at a time is changed. Not every row is tried
    like this: with many factors there are too many.

    Args:
        place: Factor of the value.
        value: The value.
        values: The values of each factor.
        usual: Completes a row of which some values are given.
        admits: Whether a row can work.
    """
    missing = {(i, each) for i, some in enumerate(values) if i != place for each in some}
    for turn in range(max(map(len, values))):
        given = dict(enumerate(some[turn % len(some)] for some in values)) | {place: value}
        row = tuple(given[i] for i in range(len(values)))
        if missing.intersection(enumerate(row)) and admits(row):
            missing -= set(enumerate(row))
            yield row
    for i, each in sorted(missing):
        fixed = {place: value, i: each}
        changes: list[dict[int, str]] = [{}]
        changes += [{j: v} for j, some in enumerate(values) if j not in fixed for v in some]
        rows = (usual({**fixed, **change}) for change in changes)
        found = next(filter(admits, dict.fromkeys(rows)), None)
        if found is not None:
            yield found

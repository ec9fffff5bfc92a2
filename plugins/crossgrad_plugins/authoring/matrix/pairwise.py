"""Few cases that still bring a component together with every other one."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TypeAlias

#: One value per factor.
Row: TypeAlias = tuple[str, ...]


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

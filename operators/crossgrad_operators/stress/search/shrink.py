"""Smaller cases that are nearly as bad, for a report that can be read and typed."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from crossgrad_operators.stress.search.batch import Batch
from crossgrad_operators.stress.search.examine import Examined, examine
from crossgrad_operators.stress.search.families import Rows, rounded
from crossgrad_operators.stress.search.samples import Sample
from crossgrad_operators.stress.search.subject import Subject

#: What a smaller case must keep of the value.
KEPT = 0.7
#: Significant digits that elements are rounded to.
DIGITS = (1, 2, 4)


def shrunk(subject: Subject, specimen: Sample, *, inside: bool) -> Sample:
    """The case without the rows, elements and digits that it does not need.

    Args:
        subject: The operator.
        specimen: A case of a large error inside the set, or of a long result outside.
        inside: Which of the two.
    """
    least = KEPT * specimen.value
    while True:
        for candidates in _smaller(subject, specimen):
            batch = Batch(candidates, specimen.dtype, specimen.family)
            values = _values(examine(subject, batch), inside=inside)
            place = int(np.argmax(values))
            if values[place] >= least:
                rows, value = candidates[place], float(values[place])
                specimen = replace(specimen, rows=rows, value=value)
                break
        else:
            return specimen


def _values(examined: Examined, *, inside: bool) -> np.ndarray:
    of_kind = examined.inside if inside else ~examined.inside
    value = examined.error if inside else examined.ratio
    return np.where(of_kind & examined.finite, value, -1.0)


def _smaller(subject: Subject, specimen: Sample) -> Iterator[Rows]:
    """[B, K', P'] cases with one row or element less, then with fewer digits."""
    rows = specimen.rows
    views, elements = rows.shape
    if views > 2 and subject.operator.views.admits(views - 1):  # noqa: PLR2004
        yield np.stack([np.delete(rows, k, axis=0) for k in range(views)])
    if elements > 1:
        yield np.stack([np.delete(rows, p, axis=1) for p in range(elements)])
    for digits in DIGITS:
        short = rounded(_to_digits(rows, digits), specimen.dtype)
        if not np.array_equal(short, rows):
            yield short[None]


def _to_digits(rows: Rows, digits: int) -> Rows:
    return np.array([[float(f"{value:.{digits - 1}e}") for value in row] for row in rows.tolist()])

"""Smaller cases that are nearly as bad, for a report that can be read and typed."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch

from crossgrad_operators.stress.search.batch import Batch
from crossgrad_operators.stress.search.examine import examine
from crossgrad_operators.stress.search.families import Rows, rounded
from crossgrad_operators.stress.search.samples import Sample
from crossgrad_operators.stress.search.worst_cases import severity
from crossgrad_operators.stress.suite import Subject

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
        for rows in _smaller(subject, specimen.rows, specimen.dtype):
            batch = Batch(rows[None], specimen.dtype, specimen.family)
            value = severity(examine(subject, batch)[0], inside=inside)
            if value >= least:
                specimen = replace(specimen, rows=rows, value=value)
                break
        else:
            return specimen


def _smaller(subject: Subject, rows: Rows, dtype: torch.dtype) -> Iterator[Rows]:
    """Cases with fewer rows or elements (half of them, a quarter, ... one), then fewer digits."""
    for part in _parts(len(rows), least=2):
        if subject.operator.views.admits(len(rows) - len(part)):
            yield np.delete(rows, part, axis=0)
    for part in _parts(rows.shape[1], least=1):
        yield np.delete(rows, part, axis=1)
    for digits in DIGITS:
        short = rounded(_to_digits(rows, digits), dtype)
        if not np.array_equal(short, rows):
            yield short


def _parts(count: int, least: int) -> Iterator[range]:
    """Ranges of places to leave out, the longest first; at least `least` places are left."""
    size = count // 2
    while size:
        for first in range(0, count, size):
            part = range(first, min(first + size, count))
            if count - len(part) >= least:
                yield part
        size //= 2


def _to_digits(rows: Rows, digits: int) -> Rows:
    return np.array([[float(f"{value:.{digits - 1}e}") for value in row] for row in rows.tolist()])

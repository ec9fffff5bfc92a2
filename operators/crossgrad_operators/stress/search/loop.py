"""Search for the worst gradients in rounds: new gradients, then mutants of the worst cases."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from time import monotonic
from zlib import crc32

import numpy as np
import torch

from crossgrad_core.numerics.threads import on_one_thread
from crossgrad_operators.stress.exact import DIGITS, require_mpmath
from crossgrad_operators.stress.runner import UNPROVEN, judged
from crossgrad_operators.stress.search.examine import exact_case, examine, largest_jump
from crossgrad_operators.stress.search.families import (
    FAMILIES,
    Batch,
    Rows,
    cases_of,
    rounded,
    search_views,
    sizes,
)
from crossgrad_operators.stress.search.samples import Sample, mutants
from crossgrad_operators.stress.search.worst_cases import WorstCases, severity, specimen
from crossgrad_operators.stress.suite import Subject

#: Number of cases in a round whose gradients are changed slightly. A case with a slight change
#: needs no exact arithmetic.
JUMPS = 64
#: A simplified case must keep at least this share of the original value.
KEPT = 0.7
#: Numbers of significant digits to which elements are rounded in a simplified case.
FEW_DIGITS = (1, 2, 4)


@dataclass(frozen=True)
class Extent:
    """The start and the length of a search.

    Attributes:
        seed: Seed of all random numbers. A longer search begins with the cases of a shorter search.
        seconds: No new round begins after this time.
        rounds: Largest number of rounds; None without a limit.
        dtypes: Types of the gradients, used in turn.
    """

    seed: int = 0
    seconds: float = float("inf")
    rounds: int | None = None
    dtypes: tuple[torch.dtype, ...] = (torch.float32, torch.float64)


def search(
    subjects: Sequence[Subject],
    extent: Extent,
    progress: Callable[[int, Sequence[WorstCases]], None] = lambda _turn, _tallies: None,
) -> list[WorstCases]:
    """Search for the worst gradients of each operator.

    Raises:
        UserError: mpmath is not installed.
    """
    mpmath = require_mpmath()
    tallies = [[WorstCases(subject.name, dtype) for subject in subjects] for dtype in extent.dtypes]
    every = [tally for group in tallies for tally in group]
    end, turn = monotonic() + extent.seconds, 0
    with mpmath.mp.workdps(DIGITS), on_one_thread():
        while turn == 0 or (monotonic() < end and turn != extent.rounds):
            index = turn % len(extent.dtypes)
            batch = fresh(extent, turn)
            for subject, tally in zip(subjects, tallies[index], strict=True):
                _round(subject, tally, batch, (extent.seed, turn))
            turn += 1
            progress(turn, every)
        for index, subject in enumerate(subjects):
            for group in tallies:
                _simplify(subject, group[index])
    return every


def _simplify(subject: Subject, tally: WorstCases) -> None:
    """Simplify the worst cases."""
    for pool, inside in ((tally.inside_pool, True), (tally.outside_pool, False)):
        if pool and np.isfinite(pool[0].value):
            pool[0] = shrunk(subject, pool[0], inside=inside)


def fresh(extent: Extent, turn: int) -> Batch:
    """Return the new gradients of a round."""
    type_index, cycle = turn % len(extent.dtypes), turn // len(extent.dtypes)
    rng = np.random.default_rng([extent.seed, turn])
    family = list(FAMILIES)[cycle % len(FAMILIES)]
    views, elements = sizes(rng, family)
    dtype = extent.dtypes[type_index]
    rows = FAMILIES[family](rng, max(JUMPS, cases_of(views)), views, elements)
    return Batch(rounded(rows, dtype), dtype, family)


def _round(subject: Subject, tally: WorstCases, batch: Batch, at: tuple[int, int]) -> None:
    admitted = subject.operator.views
    if not admitted.admits(batch.views):
        # An operator that supports only two views receives the first two views of each case.
        batch = Batch(batch.rows[:, :2], batch.dtype, batch.family)
    if not admitted.admits(batch.views):
        return
    seed, turn = at
    rng = np.random.default_rng([seed, turn, crc32(subject.name.encode())])
    examined = Batch(batch.rows[: cases_of(batch.views)], batch.dtype, batch.family)
    tally.add(examined, examine(subject, examined), turn)
    if subject.reference.oracle is not None:
        _over_steps(subject, tally, batch, turn)
        moved = Batch(batch.rows[:JUMPS], batch.dtype, batch.family)
        jump = largest_jump(subject, moved, rng)
        if jump is not None:
            tally.jumped(specimen(moved, jump[0], turn, jump[1]))
    if tally.pool:
        variants = mutants(rng, tally.pool, admitted)
        tally.add(variants, examine(subject, variants), turn)


def _over_steps(subject: Subject, tally: WorstCases, batch: Batch, turn: int) -> None:
    """Run one case over several steps, for operators that store values between steps."""
    finding, _ = judged(subject.operator, exact_case(batch, 0), subject.reference, search_views)
    if finding.verdict == "failed" and finding.reason != UNPROVEN:
        tally.fail(specimen(batch, 0, turn), f"over several steps: {finding.reason}")


def shrunk(subject: Subject, specimen: Sample, *, inside: bool) -> Sample:
    """Return a case without unnecessary rows, elements and digits.

    Args:
        subject: The operator to test.
        specimen: The case. The case has a large error inside the set, or a long result outside the
            set.
        inside: True if the value of the case is an error inside the set.
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
    """Yield cases with fewer rows or elements (by half, a quarter, ... one), then fewer digits."""
    for removed in _parts(len(rows), least=2):
        if subject.operator.views.admits(len(rows) - len(removed)):
            yield np.delete(rows, removed, axis=0)
    for removed in _parts(rows.shape[1], least=1):
        yield np.delete(rows, removed, axis=1)
    for digits in FEW_DIGITS:
        short = rounded(_to_digits(rows, digits), dtype)
        if not np.array_equal(short, rows):
            yield short


def _parts(count: int, least: int) -> Iterator[range]:
    """Yield ranges of indices that can be removed, the longest first.

    At least `least` indices remain.
    """
    size = count // 2
    while size:
        for first in range(0, count, size):
            indices = range(first, min(first + size, count))
            if count - len(indices) >= least:
                yield indices
        size //= 2


def _to_digits(rows: Rows, digits: int) -> Rows:
    return np.array([[float(f"{value:.{digits - 1}e}") for value in row] for row in rows.tolist()])

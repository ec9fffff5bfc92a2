"""Rounds of the search: fresh gradients for all operators, then mutants of each one's worst."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import monotonic
from zlib import crc32

import numpy as np
import torch

from crossgrad_core.numerics.threads import on_one_thread
from crossgrad_operators.stress.case import short
from crossgrad_operators.stress.exact import DIGITS, require_mpmath
from crossgrad_operators.stress.runner import UNPROVEN, judged
from crossgrad_operators.stress.search.batch import Batch, search_views
from crossgrad_operators.stress.search.examine import Examined, examine, jumps
from crossgrad_operators.stress.search.families import FAMILIES, rounded, sizes
from crossgrad_operators.stress.search.samples import mutants
from crossgrad_operators.stress.search.shrink import shrunk
from crossgrad_operators.stress.search.subject import Subject
from crossgrad_operators.stress.search.worst_cases import WorstCases, specimen
from crossgrad_operators.stress.verdict import ExactCase

#: Cases of a batch.
BATCH = 64
#: Cases that slow checks make do with.
FEW = 16
#: Views up to which a case of each round is also held against 50 digits, which take long for more.
SAMPLED_VIEWS = 5


@dataclass(frozen=True)
class Extent:
    """How far a search goes, and from where.

    Attributes:
        seed: Of all its random numbers; a longer search begins with the cases of a shorter one.
        seconds: Rounds begin until then.
        rounds: Their largest number, None for any.
        dtypes: Types of gradients, in turn.
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
    """Looks for the worst gradients of every operator.

    Raises:
        UserError: mpmath is not installed.
    """
    mpmath = require_mpmath()
    tallies = [[WorstCases(each.name, dtype) for each in subjects] for dtype in extent.dtypes]
    every = [tally for group in tallies for tally in group]
    end, turn = monotonic() + extent.seconds, 0
    with mpmath.mp.workdps(DIGITS), on_one_thread():
        while turn == 0 or (monotonic() < end and turn != extent.rounds):
            place = turn % len(extent.dtypes)
            batch = fresh(extent, turn)
            for subject, tally in zip(subjects, tallies[place], strict=True):
                _round(subject, tally, batch, (extent.seed, turn))
            turn += 1
            progress(turn, every)
        for place, subject in enumerate(subjects):
            for group in tallies:
                _simplify(subject, group[place])
    return every


def _simplify(subject: Subject, tally: WorstCases) -> None:
    """Leaves out of the worst cases what they do not need."""
    for pool, inside in ((tally.inside_pool, True), (tally.outside_pool, False)):
        if pool and np.isfinite(pool[0].value):
            pool[0] = shrunk(subject, pool[0], inside=inside)


def fresh(extent: Extent, turn: int) -> Batch:
    """The gradients of a round."""
    place, index = turn % len(extent.dtypes), turn // len(extent.dtypes)
    rng = np.random.default_rng([extent.seed, turn])
    family = list(FAMILIES)[index % len(FAMILIES)]
    views, elements = sizes(rng, family)
    dtype = extent.dtypes[place]
    return Batch(rounded(FAMILIES[family](rng, BATCH, views, elements), dtype), dtype, family)


def _round(subject: Subject, tally: WorstCases, batch: Batch, at: tuple[int, int]) -> None:
    admitted = subject.operator.views
    if not admitted.admits(batch.views):
        # Pairs of the same kind instead, for operators that take no more.
        batch = Batch(batch.rows[:, :2], batch.dtype, batch.family)
    if not admitted.admits(batch.views):
        return
    seed, turn = at
    rng = np.random.default_rng([seed, turn, crc32(subject.name.encode())])
    size = BATCH
    if subject.quick is None and subject.reference.rule is None:
        # Held against laws alone, by running it again and again; it may be slow.
        size = FEW
        batch = Batch(batch.rows[:size], batch.dtype, batch.family)
    examined = examine(subject, batch)
    tally.add(examined, turn)
    _sample(subject, tally, examined, turn)
    if subject.quick is not None:
        few = Batch(batch.rows[:FEW], batch.dtype, batch.family)
        tally.jumped(few, jumps(subject, few, rng), turn)
    if tally.pool:
        tally.add(examine(subject, mutants(rng, tally.pool, admitted, size)), turn)


def _sample(subject: Subject, tally: WorstCases, examined: Examined, turn: int) -> None:
    """Holds one case, over several steps, against the 50-digit oracle."""
    batch = examined.batch
    if batch.views > SAMPLED_VIEWS or subject.reference.oracle is None or examined.broken[0]:
        return
    case = ExactCase(short("sample", batch.rows[0], batch.dtype))
    finding, _ = judged(subject.operator, case, subject.reference, search_views)
    tally.sampled += finding.reason != UNPROVEN
    if finding.verdict == "failed" and finding.reason != UNPROVEN:
        tally.broken += 1
        tally.failures.append((specimen(examined, 0, turn), f"50 digits: {finding.reason}"))

"""Check that results are finite, for many short gradients."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Final

import numpy as np
import torch

from crossgrad_core.commands import write_table
from crossgrad_core.numerics.threads import on_one_thread
from crossgrad_operators.stress.search.families import FAMILIES, VIEWS, Batch, results, rounded
from crossgrad_operators.stress.search.samples import Sample
from crossgrad_operators.stress.suite import Subject

#: The types of gradients that are tested.
BOTH: Final = (torch.float32, torch.float64)
#: Number of cases in a batch, and largest number of elements.
BATCH, ELEMENTS = 1000, 20


@dataclass(frozen=True, eq=False)
class Finite:
    """The results of the check for one operator.

    Attributes:
        operator: Name of the operator.
        matrices: Number of tested cases.
        not_finite: Number of cases whose result is not finite.
        longest: Largest length |u| of a result, divided by the length of the longest gradient.
        seconds: Duration of the check in seconds.
        example: A case whose result is not finite; None if all results are finite.
    """

    operator: str
    matrices: int
    not_finite: int
    longest: float
    seconds: float
    example: Sample | None


@on_one_thread()
def run_finite(
    subject: Subject, matrices: int, seed: int = 0, dtypes: Sequence[torch.dtype] = BOTH
) -> Finite:
    """Run an operator on `matrices` cases with K from 2 to 20.

    The types of the gradients alternate.
    """
    start = perf_counter()
    bad, longest, example = 0, 0.0, None
    for turn, first in enumerate(range(0, matrices, BATCH)):
        dtype = dtypes[turn % len(dtypes)]
        batch = _batch(subject, dtype, min(BATCH, matrices - first), (seed, turn))
        outputs = results(subject.operator, batch)
        wrong = np.asarray(~np.isfinite(outputs).all(axis=1))
        bad += int(wrong.sum())
        if wrong.any() and example is None:
            rows = batch.rows[int(np.argmax(wrong))].copy()
            example = Sample(rows, batch.dtype, batch.family, turn, float("inf"))
        longest = max(longest, _longest(batch, np.where(wrong[:, None], 0.0, outputs)))
    return Finite(subject.name, matrices, bad, longest, perf_counter() - start, example)


def _batch(subject: Subject, dtype: torch.dtype, count: int, seed: tuple[int, int]) -> Batch:
    rng = np.random.default_rng(seed)
    # Two successive batches belong to one family of gradients. The gradients of these two batches
    # have different types.
    family = list(FAMILIES)[seed[1] // 2 % len(FAMILIES)]
    views = int(rng.integers(2, VIEWS + 1))
    if not subject.operator.views.admits(views):
        views = 2
    rows = FAMILIES[family](rng, count, views, int(rng.integers(1, ELEMENTS + 1)))
    return Batch(rounded(rows, dtype), dtype, family)


def _longest(batch: Batch, outputs: np.ndarray) -> float:
    """Return the largest length |u| of a result, divided by the length of the longest gradient."""
    length = np.linalg.norm(batch.rows, axis=2).max(axis=1)
    ratio = np.linalg.norm(outputs, axis=1) / np.where(length > 0, length, 1.0)
    return float(ratio.max(initial=0.0))


def as_text(found: Sequence[Finite]) -> str:
    """Return one line for each operator, and an example whose result is not finite."""
    head = f"{'operator':<16}{'matrices':>10}{'not finite':>12}{'longest |u|':>13}{'seconds':>9}"
    lines = [
        f"{result.operator:<16}{result.matrices:>10}{result.not_finite:>12}{result.longest:>13.3g}"
        f"{result.seconds:>9.1f}"
        for result in found
    ]
    bad = [
        f"{result.operator}, {result.example.precision}, {result.example.family}, batch "
        f"{result.example.turn}: not finite\n  --rows '{result.example.text()}'"
        for result in found
        if result.example is not None
    ]
    legend = "longest |u|: relative to the longest gradient of its case"
    return "\n".join([head, *lines, legend, *bad])


def write_csv(found: Sequence[Finite], path: Path) -> None:
    """Write one row for each operator."""
    rows: list[dict[str, str | int | float]] = [
        {
            "operator": result.operator,
            "matrices": result.matrices,
            "not_finite": result.not_finite,
            "u_longest": result.longest,
            "seconds": round(result.seconds, 1),
        }
        for result in found
    ]
    write_table(path, rows)

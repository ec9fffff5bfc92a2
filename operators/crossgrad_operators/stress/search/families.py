"""Generate batches of short gradients of kinds for which small solvers often fail."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from crossgrad_core.plugin import EMPTY_STATE, Block, GramianOperator, LearningRate, Operator
from crossgrad_operators.stress.reference import Views
from crossgrad_operators.stress.runner import context_of

Rows = NDArray[np.float64]
#: Function from (generator, B, K, P) to gradients [B, K, P].
Family = Callable[[np.random.Generator, int, int, int], Rows]
#: Largest number of views, and largest number of elements.
VIEWS, ELEMENTS = 20, 50
#: Family of ordinary gradients. For this family, the share of cases outside the set is reported.
USUAL: Final = "random"
#: Numbers of views K, and their probabilities. An exact result takes 1 ms for 2 views, and 1 s for
#: 20 views.
_VIEWS: Final = np.arange(2, VIEWS + 1)
_SHARES: Final = _VIEWS**-2.0 / (_VIEWS**-2.0).sum()
#: A batch with K views contains this number of cases, divided by K^2.
_CASES: Final = 256
#: A block in which each row of a tensor is a separate case.
BLOCK = Block("means", ("means",), True, "geometry", LearningRate(1.0))


def cases_of(views: int) -> int:
    """Return the number of cases in a batch.

    Cases with many views take longer, so that a batch contains fewer cases with many views.
    """
    return max(1, _CASES // views**2)


def rounded(rows: Rows, dtype: torch.dtype) -> Rows:
    """Return the rows after rounding to a gradient type, as float64 numbers."""
    # Add 0, so that no negative zeros remain.
    result: Rows = torch.from_numpy(rows).to(dtype).double().numpy() + 0.0
    return result


def sizes(rng: np.random.Generator, family: str) -> tuple[int, int]:
    """Draw K from 2 to 20 (mostly small) and P.

    P is at most 50 for the family `USUAL`, and else at most 2 K + 3.
    """
    views = int(rng.choice(_VIEWS, p=_SHARES))
    elements = ELEMENTS if family == USUAL else 2 * views + 3
    return views, int(rng.integers(1, elements + 1))


def _normal(rng: np.random.Generator, blocks: int, views: int, elements: int) -> Rows:
    return rng.standard_normal((blocks, views, elements))


def _powers(rng: np.random.Generator, shape: tuple[int, ...], low: float, high: float) -> Rows:
    """Return random powers of 10."""
    return np.asarray(10.0 ** rng.uniform(low, high, shape))


def usual(rng: np.random.Generator, blocks: int, views: int, elements: int) -> Rows:
    """Return normally distributed rows whose norms vary over seven decades."""
    rows = _normal(rng, blocks, views, elements)
    return rows * _powers(rng, (blocks, views, 1), -3.5, 3.5)


def integers(rng: np.random.Generator, blocks: int, views: int, elements: int) -> Rows:
    """Return small integers. Small integers cause exact ties and exactly singular Gramians."""
    bounds = rng.choice([1, 2, 9], (blocks, 1, 1))
    return np.rint(bounds * rng.uniform(-1, 1, (blocks, views, elements)))


def low_rank(rng: np.random.Generator, blocks: int, views: int, elements: int) -> Rows:
    """Return rows of rank 1 to 3.

    Half of the rows are integers, whose rank rounding does not change.
    """
    rank = int(rng.integers(1, 4))
    factors = _normal(rng, blocks, views, rank)
    basis = _normal(rng, blocks, rank, elements)
    exact = rng.random((blocks, 1, 1)) < 0.5  # noqa: PLR2004
    factors = np.where(exact, np.rint(3 * factors), factors)
    return factors @ np.where(exact, np.rint(3 * basis), basis)


def near_copies(rng: np.random.Generator, blocks: int, views: int, elements: int) -> Rows:
    """Return rows near multiples (also negative) of another row.

    The distances vary from 1 to 1e-16.
    """
    rows = _normal(rng, blocks, views, elements)
    source = rows[:, :1] * _apart(rng, blocks, elements)
    copied = rng.random((blocks, views, 1)) < rng.choice([0.3, 0.7, 1.0], (blocks, 1, 1))
    sign = np.where(rng.random((blocks, views, 1)) < rng.random((blocks, 1, 1)), 1.0, -1.0)
    distance = _powers(rng, (blocks, 1, 1), -16, 0)
    equal = rng.random((blocks, 1, 1)) < 0.5  # noqa: PLR2004
    scale = np.where(equal, 1.0, _powers(rng, (blocks, views, 1), -3, 3))
    return np.where(copied, scale * (sign * source + distance * rows), rows)


def _apart(rng: np.random.Generator, blocks: int, elements: int) -> Rows:
    """Return masks [B, 1, P] that set some elements of a row to zero.

    At these elements, small distances are represented exactly.
    """
    kept = rng.random((blocks, 1, elements)) < 0.6  # noqa: PLR2004
    kept[:, :, 0] = True
    return np.where(rng.random((blocks, 1, 1)) < 0.5, 1.0, kept)  # noqa: PLR2004


def vanishing(rng: np.random.Generator, blocks: int, views: int, elements: int) -> Rows:
    """Return rows with a convex combination near zero. The distances vary from 1 to 1e-16."""
    rows = _normal(rng, blocks, views, elements) * _apart(rng, blocks, elements)
    chosen = rng.random((blocks, views)) < rng.choice([0.3, 0.6, 1.0], (blocks, 1))
    chosen[:, 0] = True
    chosen[:, -1] = False
    weights = np.where(chosen, rng.uniform(0, 1, (blocks, views)), 0.0)
    last = -np.einsum("bk,bkp->bp", weights, rows)
    noise = _powers(rng, (blocks, 1), -16, 0) * rng.standard_normal((blocks, elements))
    rows[:, -1] = last + noise
    return rows


def ratios(rng: np.random.Generator, blocks: int, views: int, elements: int) -> Rows:
    """Return rows whose norms differ by factors of up to 1e12."""
    return _normal(rng, blocks, views, elements) * _powers(rng, (blocks, views, 1), -6, 6)


def zeros(rng: np.random.Generator, blocks: int, views: int, elements: int) -> Rows:
    """Return rows that contain exact zeros: complete rows and single elements."""
    rows = _normal(rng, blocks, views, elements)
    rows *= rng.random((blocks, views, 1)) < 0.7  # noqa: PLR2004
    return np.asarray(rows * (rng.random(rows.shape) < rng.uniform(0.2, 1, (blocks, 1, 1))))


def mixed(rng: np.random.Generator, blocks: int, views: int, elements: int) -> Rows:
    """Return near copies or vanishing combinations whose norms differ by factors of up to 1e12."""
    first = near_copies if rng.random() < 0.5 else vanishing  # noqa: PLR2004
    rows = first(rng, blocks, views, elements)
    return rows * _powers(rng, (blocks, views, 1), -6, 6)


FAMILIES: Final[Mapping[str, Family]] = {
    USUAL: usual,
    "integers": integers,
    "low rank": low_rank,
    "near copies": near_copies,
    "vanishing": vanishing,
    "ratios": ratios,
    "zeros": zeros,
    "mixed": mixed,
}


@dataclass(frozen=True, eq=False)
class Batch:
    """B cases of equal size.

    Attributes:
        rows: [B, K, P] gradients, exactly represented in their type.
        dtype: Type of the gradients.
        family: Name of the family of gradients.
    """

    rows: Rows
    dtype: torch.dtype
    family: str

    @property
    def views(self) -> int:
        """The number of views K."""
        return int(self.rows.shape[1])


def search_views(count: int, seed: int = 0) -> Views:
    """Return views that are alternately near and far.

    The distances of the views are powers of two, so that products of their powers are exact.
    """
    labels = tuple(("near", "far")[k % 2] for k in range(count))
    return Views(labels, tuple(2.0 ** (k % 6 - 2) for k in range(count)), seed)


def results(operator: Operator, batch: Batch, views: Views | None = None) -> Rows:
    """Return the results [B, P] of an operator for each case.

    A case that raises an error gives NaN.
    """
    if isinstance(operator, GramianOperator):
        operator = operator.model_copy(update={"granularity": "gaussian"})
    return _results(operator, batch.rows, batch.dtype, views or search_views(batch.views))


def _results(operator: Operator, rows: Rows, dtype: torch.dtype, views: Views) -> Rows:
    gradients = [
        {BLOCK.name: torch.from_numpy(np.ascontiguousarray(rows[:, k])).to(dtype)}
        for k in range(rows.shape[1])
    ]
    context = context_of(gradients, (BLOCK,), views)
    try:
        combined = operator.aggregate(context, EMPTY_STATE)[0].gradients[BLOCK.name]
    except Exception:
        # An operator of another package may raise any exception.
        return _halved(operator, rows, dtype, views)
    if combined is None:
        return np.full(rows[:, 0].shape, np.nan)
    result: Rows = combined.detach().double().numpy()
    return result


def _halved(operator: Operator, rows: Rows, dtype: torch.dtype, views: Views) -> Rows:
    """Split the batch, to find the cases that raise an error.

    The results of all other cases are returned as usual.
    """
    if len(rows) == 1:
        return np.full(rows[:, 0].shape, np.nan)
    half = len(rows) // 2
    halves = (rows[:half], rows[half:])
    return np.concatenate([_results(operator, half_rows, dtype, views) for half_rows in halves])

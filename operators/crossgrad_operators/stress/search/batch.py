"""Many short gradients at once: the rows of a block under granularity `gaussian`."""

from dataclasses import dataclass

import numpy as np
import torch

from crossgrad_core.plugin import EMPTY_STATE, Block, GramianOperator, LearningRate, Operator
from crossgrad_operators.stress.reference import Views
from crossgrad_operators.stress.runner import context_of
from crossgrad_operators.stress.search.families import Rows

#: The block whose rows are gradients of their own.
BLOCK = Block("means", ("means",), True, "geometry", LearningRate(1.0))


@dataclass(frozen=True, eq=False)
class Batch:
    """B cases of equal size.

    Attributes:
        rows: [B, K, P] gradients, exact in their type.
        dtype: Type of the gradients.
        family: Where they come from.
    """

    rows: Rows
    dtype: torch.dtype
    family: str

    @property
    def views(self) -> int:
        """K."""
        return int(self.rows.shape[1])


def search_views(count: int, seed: int = 0) -> Views:
    """Near and far views in turn, at distances whose powers multiply gradients without error."""
    labels = tuple(("near", "far")[k % 2] for k in range(count))
    return Views(labels, tuple(2.0 ** (k % 6 - 2) for k in range(count)), seed)


def results(operator: Operator, batch: Batch, views: Views | None = None) -> Rows:
    """[B, P] what an operator makes of each case; NaN where it raises an error."""
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
        found = operator.aggregate(context, EMPTY_STATE)[0].gradients[BLOCK.name]
    except Exception:
        # Third-party code may raise anything.
        return _halved(operator, rows, dtype, views)
    if found is None:
        return np.full(rows[:, 0].shape, np.nan)
    result: Rows = found.detach().double().numpy()
    return result


def _halved(operator: Operator, rows: Rows, dtype: torch.dtype, views: Views) -> Rows:
    """The cases that raise the error found by halves, so that the others keep their results."""
    if len(rows) == 1:
        return np.full(rows[:, 0].shape, np.nan)
    half = len(rows) // 2
    parts = (rows[:half], rows[half:])
    return np.concatenate([_results(operator, part, dtype, views) for part in parts])

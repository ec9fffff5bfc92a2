"""How often gradients of near and far views conflict, in both readings of the paper's rate."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Conflict:
    """Conflict between near and far views, over all pairs of one near and one far view.

    A pair counts for a block if both gradients are non-zero and overlap; disjoint gradients are
    orthogonal without agreeing.

    Attributes:
        per_block: [B] share of the counted pairs whose dot product is negative; NaN without pairs.
        per_pair: Share of a pair's counted blocks that conflict, averaged over pairs; NaN without.
        pairs: [B] counted pairs.
        disjoint: [B] pairs of non-zero gradients that do not overlap.
        zero: [B] pairs with a zero gradient.
    """

    per_block: NDArray[np.float64]
    per_pair: float
    pairs: NDArray[np.int64]
    disjoint: NDArray[np.int64]
    zero: NDArray[np.int64]


def conflict(
    gramians: NDArray[np.float64],
    near: NDArray[np.bool_],
    overlap: NDArray[np.bool_] | None = None,
) -> Conflict:
    """Both readings of the paper's "33-83 %" conflict rate.

    Args:
        gramians: [B, V, V].
        near: [V], the views of the near group; the others are far.
        overlap: [B, V, V], pairs whose gradients share a non-zero element; by default every pair
            whose dot product is not exactly zero.
    """
    products = gramians[:, near][:, :, ~near]
    norms = np.einsum("bii->bi", gramians)
    nonzero = (norms[:, near, None] > 0.0) & (norms[:, None, ~near] > 0.0)
    meets = products != 0.0 if overlap is None else overlap[:, near][:, :, ~near]
    counted = nonzero & meets
    negative = counted & (products < 0.0)
    return Conflict(
        per_block=_share(negative.sum(axis=(1, 2)), counted.sum(axis=(1, 2))),
        per_pair=_mean(_share(negative.sum(axis=0), counted.sum(axis=0))),
        pairs=counted.sum(axis=(1, 2)),
        disjoint=(nonzero & ~meets).sum(axis=(1, 2)),
        zero=(~nonzero).sum(axis=(1, 2)),
    )


def _share(part: NDArray[np.int64], whole: NDArray[np.int64]) -> NDArray[np.float64]:
    """The quotient, NaN where the whole is empty."""
    return np.where(whole > 0, part / np.maximum(whole, 1), np.nan)


def _mean(values: NDArray[np.float64]) -> float:
    """Mean of the values that are not NaN; NaN without any."""
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else float("nan")

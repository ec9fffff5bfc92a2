"""Orders and gates of pairwise projections."""

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import OperatorContext

#: Gradients whose unit roundoff is below this have Gramians that are no closer than they are.
NARROW = 1e-12


def slot_order(views: int) -> NDArray[np.int64]:
    """[K, K] partners of each view in the order of their slots."""
    return np.tile(np.arange(views), (views, 1))


def random_order(views: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """[K, K] partners of each view in random order; nothing is drawn where there is one partner."""
    order = slot_order(views)
    return order if views <= 2 else rng.permuted(order, axis=1)  # noqa: PLR2004


def project(
    gramians: NDArray[np.float64],
    context: OperatorContext,
    order: NDArray[np.int64],
    *,
    gates: NDArray[np.bool_] | None = None,
    threshold: float = 0.0,
    strength: float = 1.0,
) -> NDArray[np.float64]:
    """[B, K, K] matrices that project each gradient against the others where they conflict.

    Args:
        gramians: [B, K, K].
        context: Tells which views are present.
        order: [K, K] for each view the order of its partners.
        gates: [B, K, K] which pairs may be projected; all by default.
        threshold: Only cosines below minus this count as a conflict.
        strength: The share of the conflicting component that is taken away.
    """
    from crossgrad_operators.numba_kernels.projection import projected

    if gates is None:
        gates = np.ones(gramians.shape, np.bool_)
    rule = (float(threshold), float(strength))
    # Two views take one step each, whose errors are those of the cosine. More of them add up, to
    # nothing that float32 gradients would show.
    many = gramians.shape[1] > 2  # noqa: PLR2004
    if context.unit < NARROW and many and context.rounding_residuals is not None:
        rest = context.rounding_residuals()
        return projected(gramians, rest, context.present, order, gates, rule, True)
    rest = np.zeros_like(gramians)
    return projected(gramians, rest, context.present, order, gates, rule, None)

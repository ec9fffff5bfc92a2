"""Operators of pairwise projection: each gradient loses what conflicts with the others."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from typing_extensions import override

from crossgrad_core.plugin import GramianOperator, OperatorContext, PluginState, Selection

#: Gradients whose unit roundoff is below this have Gramians that are no closer than they are.
NARROW = 1e-12


class Symmetric(GramianOperator):
    """Where two gradients conflict, each loses its component along the other; then they are added.

    g_1' = g_1 - (m / |g_2|^2) g_2 and g_2' = g_2 - (m / |g_1|^2) g_1 for m = g_1.g_2 < 0 (paper,
    equations proj_near, proj_far and final_update): two-task PCGrad. With more than two views every
    ordered pair is treated in the order of the slots, always with the original partner.

    The primary operator of CrossGrad-GS (arXiv 2605.00052).
    """

    identity_at_one: ClassVar[bool] = True

    @override
    def transform(
        self,
        gramians: NDArray[np.float64],
        context: OperatorContext,
        state: PluginState,
        rng: np.random.Generator,
    ) -> tuple[NDArray[np.float64], PluginState]:
        return project(gramians, context, slot_order(gramians.shape[1])), state


class PCGrad(GramianOperator):
    """Each gradient loses its components against conflicting partners, in random order.

    For each i: v = g_i; for j != i in random order: if v.g_j < 0, v -= (v.g_j / |g_j|^2) g_j, with
    the original g_j; u is the sum of the v. One order per step serves all blocks; with two views
    there is nothing to draw.

    Source: Yu et al. 2020, "Gradient surgery for multi-task learning", algorithm 1.
    """

    identity_at_one: ClassVar[bool] = True

    @override
    def transform(
        self,
        gramians: NDArray[np.float64],
        context: OperatorContext,
        state: PluginState,
        rng: np.random.Generator,
    ) -> tuple[NDArray[np.float64], PluginState]:
        order = random_order(gramians.shape[1], rng)
        return project(gramians, context, order), state


class Soft(GramianOperator):
    """Where cos(g_i, g_j) < -threshold, `strength` times the component along g_j is taken away.

    v -= strength (v.g_j / |g_j|^2) g_j. Threshold 0 and strength 1 are `symmetric`, strength 0 is
    `sum`; the rule jumps at a threshold above 0. Pairs in the order of the slots.
    """

    identity_at_one: ClassVar[bool] = True
    threshold: float = Field(0.0, ge=0, le=1, description="conflicts are cosines below minus this")
    strength: float = Field(1.0, ge=0, le=1, description="share of the component that is removed")

    @override
    def reads_gramians(self) -> bool:
        return self.strength > 0

    def unused_options(self, selection: Selection) -> Mapping[str, str]:
        """See `HasUnusedOptions`."""
        if self.strength > 0:
            return {}
        return {"threshold": "nothing is taken away where strength = 0; leave it out"}

    @override
    def transform(
        self,
        gramians: NDArray[np.float64],
        context: OperatorContext,
        state: PluginState,
        rng: np.random.Generator,
    ) -> tuple[NDArray[np.float64], PluginState]:
        matrices = project(
            gramians,
            context,
            slot_order(gramians.shape[1]),
            threshold=self.threshold,
            strength=self.strength,
        )
        return matrices, state


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

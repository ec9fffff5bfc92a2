"""Operators that project pairs of gradients, so that a gradient loses conflicting components."""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from typing_extensions import override

from crossgrad_core.plugin import GramianOperator, OperatorContext, PluginState, Selection

#: If the unit roundoff of the gradients is below this value, float64 Gramians are not more precise
#: than the gradients.
NARROW = 1e-12


class Symmetric(GramianOperator):
    """A sum of projected gradients.

    In a conflicting pair, each gradient loses its component along the other gradient.

    For m = g_1.g_2 < 0, g_1' = g_1 - (m / |g_2|^2) g_2 and g_2' = g_2 - (m / |g_1|^2) g_1. The
    equations proj_near, proj_far and final_update of the paper have this form, and equal PCGrad for
    two tasks. With more than two views, every ordered pair is projected in the order of the views
    in the step. The other gradient of a pair is always the original gradient.

    The paper CrossGrad-GS (arXiv 2605.00052) uses this operator as its main operator.
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
    """A sum of projected gradients, where conflicts are processed in random order.

    For each view i, v starts as g_i. For all j != i in random order, if v.g_j < 0, v -= (v.g_j /
    |g_j|^2) g_j with the original g_j. The result u is the sum of all v. In a step, all blocks use
    one random order. With two views, no random number is drawn.

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
    """Remove `strength` times the component along g_j from g_i if cos(g_i, g_j) < -`threshold`.

    For the present vector v of view i, v -= strength (v.g_j / |g_j|^2) g_j. With threshold 0 and
    strength 1, the result equals the operator `symmetric`. With strength 0, the result equals the
    operator `sum`. With a threshold above 0, the result is not continuous in the gradients. Pairs
    are processed in the order of the views in the step.
    """

    identity_at_one: ClassVar[bool] = True
    threshold: float = Field(
        0.0, ge=0, le=1, description="cosines below minus this value count as conflicts"
    )
    strength: float = Field(
        1.0, ge=0, le=1, description="share of the conflicting component that is removed"
    )

    @override
    def reads_gramians(self) -> bool:
        return self.strength > 0

    def unused_options(self, selection: Selection) -> Mapping[str, str]:
        """Return the options that have no effect (see `HasUnusedOptions`)."""
        if self.strength > 0:
            return {}
        return {"threshold": "strength = 0 removes nothing; leave the option out"}

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
    """Return the other views [K, K] of each view, in the order of the views in the step."""
    return np.tile(np.arange(views), (views, 1))


def random_order(views: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return the other views [K, K] of each view, in random order.

    With at most two views, no random number is drawn.
    """
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
    """Return the matrices [B, K, K] that project each gradient against its conflicts.

    Args:
        gramians: [B, K, K] Gramians.
        context: The context, which contains the views that are present and the precision of the
            gradients.
        order: [K, K] order of the other views for each view.
        gates: [B, K, K] True for pairs that may be projected. If `gates` is None, all pairs may be
            projected.
        threshold: Only cosines below minus this value count as conflicts.
        strength: Share of the conflicting component that is removed.
    """
    from crossgrad_operators.numba_kernels.projection import projected

    if gates is None:
        gates = np.ones(gramians.shape, np.bool_)
    rule = (float(threshold), float(strength))
    # With two views, the error of a projection is the error of a single cosine. With more views,
    # the errors of several cosines add up. For float32 gradients, the errors of the cosines are
    # below the precision of the gradients.
    many = gramians.shape[1] > 2  # noqa: PLR2004
    if context.unit < NARROW and many and context.rounding_residuals is not None:
        rest = context.rounding_residuals()
        return projected(gramians, rest, context.present, order, gates, rule, True)
    rest = np.zeros_like(gramians)
    return projected(gramians, rest, context.present, order, gates, rule, None)

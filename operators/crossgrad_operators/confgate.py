"""Confidence-gated projection (arXiv 2605.00052, appendix; all numbers are ours)."""

from collections.abc import Mapping
from statistics import NormalDist
from typing import ClassVar, Final, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from typing_extensions import override

from crossgrad_core.plugin import GramianOperator, OperatorContext, PluginState, Selection
from crossgrad_operators._memory import recall, remember
from crossgrad_operators.projection import project, slot_order

_THRESHOLDS: Final = {"v2": 0.9, "low": 0.6}


class ConfGate(GramianOperator):
    """Projects a pair only if the pair conflicts now and has probably done so for some time.

    The mean mu and the variance v of the block's cosine are exponential averages (bias-corrected)
    with n_eff = (1 + beta) / (1 - beta) effective samples. P(conflict) = Phi(-mu / sqrt(v / n_eff +
    1e-12)). The operator is `symmetric` if m < 0 and P >= tau, else `sum`. A pair is not projected
    in its first `warmup` updates. Pairs with a zero gradient or without a common element (m = 0)
    are not counted.
    """

    identity_at_one: ClassVar[bool] = True
    variant: Literal["v2", "low"] = Field("v2", description="v2: tau 0.9; low: tau 0.6")
    tau: float | None = Field(
        None,
        gt=0,
        lt=1,
        description="probability of conflict above which gradients are projected; overrides "
        "variant",
    )
    beta: float = Field(0.99, ge=0, lt=1, description="decay of the averages per step")
    warmup: int = Field(100, ge=0, description="updates of a pair before the pair may be projected")

    def unused_options(self, selection: Selection) -> Mapping[str, str]:
        """Return the options without an effect; see `HasUnusedOptions`."""
        return (
            {}
            if self.tau is None
            else {"variant": "tau overrides it; leave out one of the two options"}
        )

    @override
    def transform(
        self,
        gramians: NDArray[np.float64],
        context: OperatorContext,
        state: PluginState,
        rng: np.random.Generator,
    ) -> tuple[NDArray[np.float64], PluginState]:
        from crossgrad_operators.numba_kernels.gates import confident

        views = gramians.shape[1]
        tau = _THRESHOLDS[self.variant] if self.tau is None else self.tau
        score = NormalDist().inv_cdf(tau)
        moments = recall(state, context, "moments", (3, views, views))
        gates = confident(moments, gramians, context.present, self.beta, score, self.warmup)
        matrices = project(gramians, context, slot_order(views), gates=gates)
        return matrices, remember(state, context, "moments", moments)

"""Confidence-gated projection (arXiv 2605.00052, appendix; crossgrad chose all numeric values)."""

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
    """Project a pair of views only if it conflicts now and has probably done so for some time.

    The mean mu and variance v of the cosine of a pair are bias-corrected exponential averages. The
    averages correspond to n_eff = (1 + beta) / (1 - beta) samples. The probability of a conflict is
    P = Phi(-mu / sqrt(v / n_eff + 1e-12)), with the normal distribution function Phi. If the dot
    product m is negative and P >= tau, the pair is processed as in `symmetric`, otherwise as in
    `sum`. A pair is not projected during its first `warmup` updates. Steps with m = 0 do not count
    as updates, for example if the gradients share no non-zero element.
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
        """Return the options that have no effect (see `HasUnusedOptions`)."""
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

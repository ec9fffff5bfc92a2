"""Operators that minimize over convex combinations of the gradients: MGDA and CAGrad."""

from collections.abc import Mapping
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from typing_extensions import override

from crossgrad_core.plugin import OperatorContext, Selection, Weighting
from crossgrad_operators._weights import Flags, Floats, extended_precision


class MGDA(Weighting):
    """The shortest convex combination of the gradients.

    Weights w >= 0 with sum w = 1 minimize |sum w_k g_k|.

    For two views, a closed form is used. For more views, the active-set method of Lawson and Hanson
    is used. For float64 gradients, weights are computed with 32 digits. The result is at most as
    long as the shortest gradient. If some convex combination of the gradients is zero, the result
    is zero.

    Source: Désidéri 2012; Sener and Koltun 2018.
    """

    identity_at_one: ClassVar[bool] = True

    @override
    def weights(
        self, gramians: NDArray[np.float64], context: OperatorContext
    ) -> NDArray[np.float64]:
        from crossgrad_operators.numba_kernels.simplex import mgda

        return extended_precision(mgda, gramians, context)


class CAGrad(Weighting):
    """The direction near the mean gradient that best decreases every loss.

    The direction maximizes the smallest decrease over all views.

    With the mean g_0, d maximizes min_k g_k.d subject to |d - g_0| <= c |g_0|. The solution is d =
    g_0 + (c |g_0| / |g_w|) g_w. Here g_w is the convex combination that minimizes g_w.g_0 + c |g_0|
    |g_w|. For two views, a closed form is used. For more views, all products g_k.d must reach a
    common level. d is the point nearest to g_0 in this polyhedron. The nearest point is found by an
    active-set method, with 32 digits for float64 gradients. A single view is unchanged.

    Source: Liu et al. 2021, "Conflict-averse gradient descent for multi-task learning".
    """

    identity_at_one: ClassVar[bool] = True
    c: float = Field(0.5, ge=0, description="radius of the search, as a share of |g_0|")
    rescale: Literal["none", "1+c", "1+c^2"] = Field("none", description="divisor of the direction")

    @override
    def reads_gramians(self) -> bool:
        return self.c > 0

    def unused_options(self, selection: Selection) -> Mapping[str, str]:
        """Return the options that have no effect (see `HasUnusedOptions`)."""
        if self.c > 0:
            return {}
        return {"rescale": "it has an effect only if c > 0; leave the option out"}

    @override
    def weights(
        self, gramians: NDArray[np.float64], context: OperatorContext
    ) -> NDArray[np.float64]:
        from crossgrad_operators.numba_kernels.simplex import cagrad

        def kernel(
            block_gramians: Floats,
            rounding_residuals: Floats,
            present: Flags,
            exact: Literal[True] | None,
        ) -> tuple[Floats, Flags]:
            return cagrad(block_gramians, rounding_residuals, present, exact, self.c)

        weights = extended_precision(kernel, gramians, context)
        several = context.present.sum(axis=1, keepdims=True) > 1
        scale = {"none": 1.0, "1+c": 1.0 / (1.0 + self.c), "1+c^2": 1.0 / (1.0 + self.c**2)}
        return weights * np.where(several, scale[self.rescale], 1.0)

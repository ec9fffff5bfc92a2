"""Weights that are computed in 16 or 32 digits, as the gradients require."""

from collections.abc import Callable
from typing import Final, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import OperatorContext

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

#: Unit roundoff of float32.
FLOAT32: Final = 2.0**-24


def refine(
    weights: Floats,
    ill_conditioned: Flags,
    gramians: Floats,
    context: OperatorContext,
    exact: Callable[[Floats, Floats, Flags], Floats],
) -> Floats:
    """Recompute ill-conditioned weights with 32 digits.

    Args:
        weights: [B, K] or rows [B, K, K], changed in place.
        ill_conditioned: [B] True for weights to recompute.
        gramians: [B, K, K].
        context: Gives the views that are present, and the rounding residuals of the Gramians. If
            the residuals are unknown, the weights are not changed.
        exact: Function from ill-conditioned Gramians, their residuals and presence [n, K] to
            their weights.

    Returns:
        `weights`.
        `weights`.
    """
    if context.rounding_residuals is not None and ill_conditioned.any():
        blocks = np.flatnonzero(ill_conditioned)
        weights[blocks] = exact(
            gramians[blocks], context.rounding_residuals()[blocks], context.present[blocks]
        )
    return weights


class CautiousKernel(Protocol):
    """A kernel with an argument for the relative error above which 16 digits are not enough."""

    def __call__(
        self,
        gramians: Floats,
        rounding_residuals: Floats,
        present: Flags,
        unit: float,
        exact: Literal[True] | None,
        /,
    ) -> tuple[Floats, Flags]: ...


def doubted(kernel: CautiousKernel, gramians: Floats, context: OperatorContext) -> Floats:
    """Return weights of 16 digits, or of 32 digits if the 16-digit weights are ill-conditioned."""
    nothing = np.zeros_like(gramians)
    weights, ill_conditioned = kernel(gramians, nothing, context.present, context.unit, None)

    def exact(chosen_gramians: Floats, rounding_residuals: Floats, present: Flags) -> Floats:
        return kernel(chosen_gramians, rounding_residuals, present, context.unit, True)[0]

    return refine(weights, ill_conditioned, gramians, context, exact)


class Kernel(Protocol):
    """A kernel: Gramians, residuals, presence, True for 32 digits -> weights, ill-conditioned."""

    def __call__(
        self,
        gramians: Floats,
        rounding_residuals: Floats,
        present: Flags,
        exact: Literal[True] | None,
        /,
    ) -> tuple[Floats, Flags]: ...


def extended_precision(kernel: Kernel, gramians: Floats, context: OperatorContext) -> Floats:
    """Return weights with as many digits as the gradients require.

    Gradients with a type finer than float32 get 32 digits if the residuals of their Gramians are
    known. Other gradients get 16 digits, and 32 digits if the kernel finds their weights
    ill-conditioned.
    """
    if context.unit < FLOAT32 and context.rounding_residuals is not None:
        return kernel(gramians, context.rounding_residuals(), context.present, True)[0]
    weights, ill_conditioned = kernel(gramians, np.zeros_like(gramians), context.present, None)

    def exact(chosen_gramians: Floats, rounding_residuals: Floats, present: Flags) -> Floats:
        return kernel(chosen_gramians, rounding_residuals, present, True)[0]

    return refine(weights, ill_conditioned, gramians, context, exact)

"""Compute weights with 16 digits, or with 32 digits if the gradients require more precision."""

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
    """Recompute ill-conditioned weights with 32 digits, and return all weights.

    Args:
        weights: [B, K] weights or [B, K, K] rows of weights, changed in place.
        ill_conditioned: [B] True for weights that are recomputed.
        gramians: [B, K, K] Gramians.
        context: The context, which contains the views that are present and the rounding residuals
            of the Gramians. If the residuals are unknown, no weights change.
        exact: Function that returns weights from Gramians, their residuals and presence [n, K],
            with 32 digits.

    Returns:
        The array `weights`.
    """
    if context.rounding_residuals is not None and ill_conditioned.any():
        blocks = np.flatnonzero(ill_conditioned)
        weights[blocks] = exact(
            gramians[blocks], context.rounding_residuals()[blocks], context.present[blocks]
        )
    return weights


class CautiousKernel(Protocol):
    """A kernel that also receives the largest relative error for which 16 digits are enough."""

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
    """Return weights with 16 digits. Ill-conditioned weights are recomputed with 32 digits."""
    nothing = np.zeros_like(gramians)
    weights, ill_conditioned = kernel(gramians, nothing, context.present, context.unit, None)

    def exact(chosen_gramians: Floats, rounding_residuals: Floats, present: Flags) -> Floats:
        return kernel(chosen_gramians, rounding_residuals, present, context.unit, True)[0]

    return refine(weights, ill_conditioned, gramians, context, exact)


class Kernel(Protocol):
    """A kernel that returns weights, and True for blocks with ill-conditioned weights.

    The arguments of the kernel are Gramians, residuals, presence, and True for 32 digits.
    """

    def __call__(
        self,
        gramians: Floats,
        rounding_residuals: Floats,
        present: Flags,
        exact: Literal[True] | None,
        /,
    ) -> tuple[Floats, Flags]: ...


def extended_precision(kernel: Kernel, gramians: Floats, context: OperatorContext) -> Floats:
    """Return weights with as many digits as the type of the gradients requires.

    For types more precise than float32, weights are computed with 32 digits if the residuals of the
    Gramians are known. For other types, weights are computed with 16 digits. Weights that the
    kernel marks as ill-conditioned are recomputed with 32 digits.
    """
    if context.unit < FLOAT32 and context.rounding_residuals is not None:
        return kernel(gramians, context.rounding_residuals(), context.present, True)[0]
    weights, ill_conditioned = kernel(gramians, np.zeros_like(gramians), context.present, None)

    def exact(chosen_gramians: Floats, rounding_residuals: Floats, present: Flags) -> Floats:
        return kernel(chosen_gramians, rounding_residuals, present, True)[0]

    return refine(weights, ill_conditioned, gramians, context, exact)

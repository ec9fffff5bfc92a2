"""Weights worked out with as many digits as the gradients ask for."""

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
    """Weights of which the doubtful ones are worked out anew, with twice the digits.

    Args:
        weights: [B, K] or rows [B, K, K], changed in place.
        ill_conditioned: [B].
        gramians: [B, K, K].
        context: Tells which views are present, and what rounding took from the Gramians; where
            that is not known, the weights stay as they are.
        exact: From the doubtful Gramians, their remainders and presence [n, K] to their weights.

    Returns:
        `weights`.
    """
    if context.rounding_residuals is not None and ill_conditioned.any():
        part = np.flatnonzero(ill_conditioned)
        weights[part] = exact(
            gramians[part], context.rounding_residuals()[part], context.present[part]
        )
    return weights


class CautiousKernel(Protocol):
    """A kernel that is told from which relative error on a weight of 16 digits is doubtful."""

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
    """Weights of 16 digits, and of 32 where the kernel finds these doubtful."""
    nothing = np.zeros_like(gramians)
    weights, ill_conditioned = kernel(gramians, nothing, context.present, context.unit, None)

    def exact(part: Floats, rounding_residuals: Floats, present: Flags) -> Floats:
        return kernel(part, rounding_residuals, present, context.unit, True)[0]

    return refine(weights, ill_conditioned, gramians, context, exact)


class Kernel(Protocol):
    """A kernel: Gramians, remainders, presence, True for 32 digits -> weights, which to doubt."""

    def __call__(
        self,
        gramians: Floats,
        rounding_residuals: Floats,
        present: Flags,
        exact: Literal[True] | None,
        /,
    ) -> tuple[Floats, Flags]: ...


def extended_precision(kernel: Kernel, gramians: Floats, context: OperatorContext) -> Floats:
    """Weights with as many digits as the gradients ask for.

    That is 32 for gradients finer than float32, if their Gramians are known that well; else 16, and
    32 where the kernel finds these doubtful.
    """
    if context.unit < FLOAT32 and context.rounding_residuals is not None:
        return kernel(gramians, context.rounding_residuals(), context.present, True)[0]
    weights, ill_conditioned = kernel(gramians, np.zeros_like(gramians), context.present, None)

    def exact(part: Floats, rounding_residuals: Floats, present: Flags) -> Floats:
        return kernel(part, rounding_residuals, present, True)[0]

    return refine(weights, ill_conditioned, gramians, context, exact)

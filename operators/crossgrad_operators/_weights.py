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


def sharpened(
    weights: Floats,
    doubtful: Flags,
    gramians: Floats,
    context: OperatorContext,
    exact: Callable[[Floats, Floats, Flags], Floats],
) -> Floats:
    """Weights of which the doubtful ones are worked out anew, with twice the digits.

    Args:
        weights: [B, K] or rows [B, K, K], changed in place.
        doubtful: [B].
        gramians: [B, K, K].
        context: Tells which views are present, and what rounding took from the Gramians; where
            that is not known, the weights stay as they are.
        exact: From the doubtful Gramians, their remainders and presence [n, K] to their weights.

    Returns:
        `weights`.
    """
    if context.remainders is not None and doubtful.any():
        part = np.flatnonzero(doubtful)
        weights[part] = exact(gramians[part], context.remainders()[part], context.present[part])
    return weights


class Kernel(Protocol):
    """A kernel: Gramians, remainders, presence, True for 32 digits -> weights, which to doubt."""

    def __call__(
        self, gramians: Floats, remainders: Floats, present: Flags, exact: Literal[True] | None, /
    ) -> tuple[Floats, Flags]: ...


def with_digits(kernel: Kernel, gramians: Floats, context: OperatorContext) -> Floats:
    """Weights with as many digits as the gradients ask for.

    That is 32 for gradients finer than float32, if their Gramians are known that well; else 16, and
    32 where the kernel finds these doubtful.
    """
    if context.unit < FLOAT32 and context.remainders is not None:
        return kernel(gramians, context.remainders(), context.present, True)[0]
    weights, doubtful = kernel(gramians, np.zeros_like(gramians), context.present, None)

    def exact(part: Floats, remainders: Floats, present: Flags) -> Floats:
        return kernel(part, remainders, present, True)[0]

    return sharpened(weights, doubtful, gramians, context, exact)

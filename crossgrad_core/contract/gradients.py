"""Gradients of K views, opaque to operators: Gramians, weighted sums, element-wise maps."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from torch import Tensor
from typing_extensions import override

#: What one Gramian covers: each block, all blocks of a kind, everything, each Gaussian of a block.
Granularity = Literal["block", "kind", "global", "gaussian"]
#: K tensors (None where a view does not touch the tensor) -> one tensor or None.
Elementwise = Callable[[str, Sequence[Tensor | None]], Tensor | None]


class Gradients(ABC):
    """The gradients of one step, block by block, whether views are kept apart or not.

    A view that is not finite for a block is left out of it.
    """

    @property
    @abstractmethod
    def views(self) -> int:
        """K."""

    @abstractmethod
    def present(self) -> NDArray[np.bool_]:
        """[B, K], views whose gradient of the block is finite and not exactly zero."""

    @abstractmethod
    def finite(self) -> NDArray[np.bool_]:
        """[B, K], views whose gradient of the block is finite."""

    def is_judged(self, name: str, gradient: Tensor) -> bool:
        """Whether `finite` is known to hold for this very tensor as it is: no need to look again.

        Args:
            name: Of the tensor that it is the gradient of.
            gradient: As `total` gave it, or anything else.
        """
        return False

    @abstractmethod
    def total(self, divisor: int = 1) -> Mapping[str, Tensor | None]:
        """Tensor name -> plain sum in the order of the views (the bits of accumulation).

        Args:
            divisor: What the sums are then divided by; K gives the mean without a further pass.

        Returns:
            None for tensors that no view touches, or whose views are all non-finite. Sparse, with
            sorted rows, where the views' gradients are (`Gaussians.on_demand`).
        """


class SeparateGradients(Gradients):
    """The gradients of the K views of one step, each of them known: opaque to operators.

    `elementwise` gives and wants dense tensors.
    """

    @abstractmethod
    def names(self, granularity: Granularity) -> tuple[str, ...]:
        """[B] name of the block (or kind) that each Gramian belongs to."""

    @property
    @abstractmethod
    def unit(self) -> float:
        """Smallest unit roundoff of the gradients' types: what results can be right to."""

    @abstractmethod
    def gramians(self, granularity: Granularity) -> NDArray[np.float64]:
        """[B, K, K] float64 Gramians; views with a non-finite gradient have zero rows."""

    @abstractmethod
    def rounding_residuals(self, granularity: Granularity) -> NDArray[np.float64]:
        """[B, K, K] what rounding took from the Gramians: the sum of both has twice the digits.

        Takes ten times as long as the Gramians.
        """

    @override
    @abstractmethod
    def present(self, granularity: Granularity = "block") -> NDArray[np.bool_]:
        """[B, K], views whose gradient is finite and not exactly zero."""

    @override
    @abstractmethod
    def finite(self, granularity: Granularity = "block") -> NDArray[np.bool_]:
        """[B, K], views whose gradient is finite."""

    @abstractmethod
    def overlap(self, granularity: Granularity) -> NDArray[np.bool_]:
        """[B, K, K], pairs of views whose gradients share a non-zero element's place."""

    @abstractmethod
    def combine(
        self, weights: NDArray[np.float64], granularity: Granularity
    ) -> Mapping[str, Tensor | None]:
        """Tensor name -> sum over views of weight times gradient.

        Args:
            weights: [B, K]; a view that is not finite for a block is left out whatever its weight.
            granularity: The one that `weights` was computed for.

        Returns:
            None for tensors that no view touches, or whose views are all non-finite; sparse where
            those of `total` are.
        """

    @abstractmethod
    def elementwise(self, function: Elementwise) -> Mapping[str, Tensor | None]:
        """Applies `function(tensor name, K gradients)` to every tensor."""

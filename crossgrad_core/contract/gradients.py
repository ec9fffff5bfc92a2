"""The gradients of the K views of a step.

Operators use these gradients only through Gramians, weighted sums and element-wise functions.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from torch import Tensor
from typing_extensions import override

#: Extent of one Gramian: a block, all blocks of a kind, all blocks, or one Gaussian of a block.
Granularity = Literal["block", "kind", "global", "gaussian"]
#: Tensor name and K tensors (None if a view does not touch the tensor) -> one tensor or None.
Elementwise = Callable[[str, Sequence[Tensor | None]], Tensor | None]


class Gradients(ABC):
    """The gradients of one step, block by block, either separate for each view or accumulated.

    A view whose gradient of a block is not finite is left out of this block.
    """

    @property
    @abstractmethod
    def views(self) -> int:
        """The number of views, K."""

    @abstractmethod
    def present(self) -> NDArray[np.bool_]:
        """Return [B, K], True for views whose gradient of the block is finite and not zero."""

    @abstractmethod
    def finite(self) -> NDArray[np.bool_]:
        """Return [B, K], True for views whose gradient of the block is finite."""

    def is_judged(self, name: str, gradient: Tensor) -> bool:
        """Return True if this gradient tensor is already known to be finite and needs no check.

        Args:
            name: Name of the parameter tensor.
            gradient: A gradient of this parameter: a result of `total`, or any other tensor.
        """
        return False

    @abstractmethod
    def total(self, divisor: int = 1) -> Mapping[str, Tensor | None]:
        """Return the sum over the views for each tensor, in the order of the views.

        The sum is bitwise equal to the gradient that the backward passes would accumulate.

        Args:
            divisor: Number by which the sums are divided, without a further pass over the data. The
                divisor K gives the mean.

        Returns:
            Tensor name -> sum; None for tensors that no view touches, or whose views are all
            non-finite. The sums are sparse, with sorted rows, if the views' gradients are sparse
            (`Gaussians.on_demand`).
        """


class SeparateGradients(Gradients):
    """The separate gradients of the K views of one step; operators cannot read single elements.

    `elementwise` passes dense tensors to its function and expects dense results.
    """

    @abstractmethod
    def names(self, granularity: Granularity) -> tuple[str, ...]:
        """Return [B] names of the block (or kind) that each Gramian belongs to."""

    @property
    @abstractmethod
    def unit(self) -> float:
        """Smallest unit roundoff of the gradients' types, which limits the accuracy of results."""

    @abstractmethod
    def gramians(self, granularity: Granularity) -> NDArray[np.float64]:
        """Return [B, K, K] float64 Gramians; views with a non-finite gradient have zero rows."""

    @abstractmethod
    def rounding_residuals(self, granularity: Granularity) -> NDArray[np.float64]:
        """Return [B, K, K], the parts of the Gramians that rounding removed.

        The sum of Gramian and residual has twice as many correct digits. The call takes ten times
        as long as `gramians`.
        """

    @override
    @abstractmethod
    def present(self, granularity: Granularity = "block") -> NDArray[np.bool_]:
        """Return [B, K], True for views whose gradient is finite and not exactly zero."""

    @override
    @abstractmethod
    def finite(self, granularity: Granularity = "block") -> NDArray[np.bool_]:
        """Return [B, K], True for views whose gradient is finite."""

    @abstractmethod
    def overlap(self, granularity: Granularity) -> NDArray[np.bool_]:
        """Return [B, K, K], True for pairs of views with a common non-zero gradient element."""

    @abstractmethod
    def combine(
        self, weights: NDArray[np.float64], granularity: Granularity
    ) -> Mapping[str, Tensor | None]:
        """Return the sum over views of weight times gradient, for each tensor.

        Args:
            weights: [B, K]; a view whose gradient of a block is not finite is left out, whatever
                its weight.
            granularity: The granularity that `weights` was computed for.

        Returns:
            Tensor name -> sum; None for tensors that no view touches, or whose views are all
            non-finite. The sums are sparse if the result of `total` is sparse.
        """

    @abstractmethod
    def elementwise(self, function: Elementwise) -> Mapping[str, Tensor | None]:
        """Apply `function(tensor name, K gradients)` to every tensor and return the results."""

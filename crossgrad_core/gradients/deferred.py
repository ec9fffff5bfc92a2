"""The running sum of the gradients of K views on a GPU.

The CPU waits for the GPU only when the sum is read.

In contrast, `SummedGradients` checks the gradients of each view in `add`. On a GPU, these checks
would make the CPU wait K times for each tensor.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from typing_extensions import override

from crossgrad_core.contract.blocks import Block
from crossgrad_core.contract.gradients import Gradients
from crossgrad_core.gradients.finite import largest


class DeferredSums(Gradients):
    """The sum of the gradients of K views, added in the order of the views.

    Gradients of single views are not stored.

    Gradients that are not finite are left out of the sum, without a wait for the GPU. `finite`,
    `present` and `total` read the largest magnitudes of all gradients in one transfer from the GPU.
    The gradients of the last view are added after this transfer.

    Args:
        blocks: The blocks of the backbone.
        views: Expected number of views K.
    """

    def __init__(self, blocks: Sequence[Block], views: int) -> None:
        self._blocks = tuple(blocks)
        self._names = tuple(name for block in blocks for name in block.tensors)
        self._expected = views
        self._sum: dict[str, Tensor] = {}
        self._last: dict[str, Tensor] = {}
        self._largest: list[dict[str, Tensor]] = []

    def add(self, view: Mapping[str, Tensor | None]) -> None:
        """Add the gradients of one more view.

        The caller must not use these gradients any more, because `add` and `total` overwrite them.

        Raises:
            RuntimeError: All expected views have already been added.
        """
        if len(self._largest) == self._expected:
            raise RuntimeError(
                f"more views were rendered than the {self._expected} views that were announced"
            )
        if self._largest:
            self._fold({name: self._kept(name) for name in self._last})
        given = {name: view.get(name) for name in self._names}
        self._last = {n: g.detach().contiguous() for n, g in given.items() if g is not None}
        self._largest.append({name: largest(g) for name, g in self._last.items()})

    @property
    @override
    def views(self) -> int:
        return len(self._largest)

    @override
    def total(self, divisor: int = 1) -> Mapping[str, Tensor | None]:
        finite = self.finite()
        if self._last:
            kept = self._tensors_of(finite[:, -1])
            self._fold({name: g for name, g in self._last.items() if name in kept})
            self._last = {}
        with_gradient = self._tensors_of(np.asarray(finite.any(axis=1)))
        sums = {
            name: self._sum.get(name) if name in with_gradient else None for name in self._names
        }
        return {n: g if g is None or divisor == 1 else g / divisor for n, g in sums.items()}

    @override
    def finite(self) -> NDArray[np.bool_]:
        return self._read[0]

    @override
    def present(self) -> NDArray[np.bool_]:
        return self._read[1]

    def _tensors_of(self, chosen: NDArray[np.bool_]) -> set[str]:
        """Return the names of all tensors in the blocks that `chosen` [B] marks as True."""
        blocks = zip(self._blocks, chosen.tolist(), strict=True)
        return {name for block, is_chosen in blocks if is_chosen for name in block.tensors}

    def _kept(self, name: str) -> Tensor:
        """Return the last view's gradient of a tensor.

        Return zeros if a gradient in its block is not finite.
        """
        block = next(block for block in self._blocks if name in block.tensors)
        sizes = [self._largest[-1][other] for other in block.tensors if other in self._last]
        gradient = self._last[name]
        kept = torch.stack(sizes).isfinite().all()
        return torch.where(kept, gradient, torch.zeros_like(gradient))

    def _fold(self, gradients: Mapping[str, Tensor]) -> None:
        for name, gradient in gradients.items():
            held = self._sum.get(name)
            self._sum[name] = gradient if held is None else held.add_(gradient)

    @cached_property
    def _read(self) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Two arrays [B, K] with an element for each block and view.

        The first array is True for finite gradients, the second array for finite non-zero
        gradients.
        """
        magnitudes = [size for view in self._largest for size in view.values()]
        values = iter(torch.stack(magnitudes).tolist() if magnitudes else ())
        sizes = [{name: next(values) for name in view} for view in self._largest]
        finite = np.ones((len(self._blocks), self.views), np.bool_)
        present = np.zeros_like(finite)
        for b, block in enumerate(self._blocks):
            for k, view in enumerate(sizes):
                of_block = np.array([view.get(name, 0.0) for name in block.tensors])
                finite[b, k] = np.isfinite(of_block).all()
                present[b, k] = finite[b, k] and of_block.any()
        return finite, present

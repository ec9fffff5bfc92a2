"""Deferred Adam steps: a row that no view of a step rendered takes this step later.

A row that was not rendered has a gradient of zero, but Adam still moves the row by its decaying
moments. The deferred steps of a row are applied when the row is next rendered, or when the whole
tensor is read. Deferred steps use the float32 operations of immediate steps, in the same order.
Deferred and immediate steps therefore give bit-identical results.

Steps run in background threads while the calling thread continues with serial work. Code that reads
the tensor waits until the step is complete.
"""

from dataclasses import dataclass, field
from functools import cached_property
from math import inf
from typing import TYPE_CHECKING, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_core.contract.blocks import AdamState
from crossgrad_core.gradients.sparse_rows import rows_of, values_of
from crossgrad_core.training.adam.coefficients import Coefficients

if TYPE_CHECKING:
    from crossgrad_core.numerics.jobs import Begun

#: Largest number of deferred steps of a row. The limit keeps the tables of steps short.
LONGEST: Final = 256
#: If at least this share of the rows has a gradient, all rows take the step in memory order.
#: With a larger share, deferred updates would take longer.
MOST_ROWS: Final = 0.15
#: With a smaller beta2, second moments may become 0 before the kernel checks the parameters again.
LEAST_BETA2: Final = 0.5


@dataclass(eq=False)
class _Behind:
    """The deferred steps of one tensor.

    Attributes:
        done: [N] number of steps that each row has taken.
        before: Number of steps before the first step in `room`. Every row has taken these earlier
            steps.
        room: [LONGEST, 5] both betas, step size, scale of the square root, and eps of each later
            step.
        count: Number of steps in `room`.
    """

    done: NDArray[np.int32]
    before: int
    room: NDArray[np.float32] = field(default_factory=lambda: np.empty((LONGEST, 5), np.float32))
    count: int = 0

    def add(self, *numbers: float) -> None:
        """Add the coefficients of one step."""
        self.room[self.count] = numbers
        self.count += 1
        vars(self).pop("table", None)

    @cached_property
    def table(self) -> NDArray[np.float32]:
        """The steps as a one-dimensional table for the kernel."""
        steps = self.room[: self.count]
        # For each step: the largest step size and the smallest root scale of this step and all
        # later steps.
        later = steps[::-1]
        most = np.maximum.accumulate(later[:, 2])[::-1]
        least = np.minimum.accumulate(later[:, 3])[::-1]
        # The bounds are valid if the first moment decays faster than the square root of the second
        # moment. In addition, the second moment must stay a normal number between two checks.
        beta1, beta2 = steps[:, 0], steps[:, 1]
        fades = bool(((beta1 <= np.sqrt(beta2)) & (beta2 >= LEAST_BETA2)).all())
        most = most if fades else np.full_like(most, inf)
        return np.column_stack([steps, most, least]).astype(np.float32).ravel()


class Late:
    """The deferred steps of all tensors, by name of the tensor."""

    def __init__(self) -> None:
        self._behind: dict[str, _Behind] = {}
        self._under_way: dict[str, Begun] = {}

    @property
    def names(self) -> frozenset[str]:
        """The names of tensors that have deferred steps or a step that is still running."""
        return frozenset(self._behind).union(self._under_way)

    def finish(self, name: str | None = None) -> None:
        """Wait until no step is running. Deferred steps remain deferred.

        Args:
            name: Name of the tensor to wait for; None means all tensors.
        """
        for tensor_name in [name] if name is not None else list(self._under_way):
            if (begun := self._under_way.get(tensor_name)) is not None:
                # If the step failed, `end` raises its error. The failed step stays in the table, so
                # that the next call raises the error again.
                begun.end()
                del self._under_way[tensor_name]

    def forget(self) -> None:
        """Discard all running and deferred steps. No thread changes a tensor after this call."""
        for begun in self._under_way.values():
            begun.leave()
        self._under_way, self._behind = {}, {}

    def step(
        self, name: str, param: Tensor, grad: Tensor, adam: AdamState, step: Coefficients
    ) -> None:
        """Take a step with the rows of the sparse gradient `grad`.

        Defer the step of all other rows.

        If `grad` contains many rows, all rows of the tensor take the step at once. The step may
        still be running after this function returns; `finish` waits for the end of the step.

        Args:
            name: Name of the tensor. The step count of the tensor in `adam` already includes this
                step.
            param: The tensor, float32 and contiguous, on the CPU.
            grad: The sparse gradient. The gradient must not change after this call.
            adam: Moments and step counts.
            step: The coefficients of the step.
        """
        from crossgrad_core.numerics.jobs import Begun
        from crossgrad_core.training.adam.numba_kernels.fused import numbers_of
        from crossgrad_core.training.adam.numba_kernels.late import update_all, update_rows

        count = adam.steps[name]
        rows = rows_of(grad).numpy().astype(np.int32)
        most = len(rows) >= MOST_ROWS * param.shape[0]
        self.catch_up(name, param, adam, None if most else torch.from_numpy(rows))
        flat, numbers, width = _flat(name, param, adam), numbers_of(step), _width(param)
        values = values_of(grad).contiguous().view(-1).numpy()
        update = update_all if most else update_rows
        begun = Begun(update, rows, width, flat[0], values, flat[1], flat[2], numbers)
        self._under_way[name] = begun
        _changed(name, param, adam)
        if most:
            return
        if name not in self._behind:
            done = np.full(param.shape[0], count - 1, np.int32)
            self._behind[name] = _Behind(done, count - 1)
        behind = self._behind[name]
        behind.done[rows] = count
        beta1, _, beta2, _, step_size, root_scale, eps, _, _ = map(float, numbers)
        behind.add(beta1, beta2, step_size, root_scale, eps)
        if behind.count == LONGEST:
            self.catch_up(name, param, adam)

    def catch_up(
        self, name: str, param: Tensor, adam: AdamState, rows: Tensor | None = None
    ) -> None:
        """Apply the deferred steps of some or all rows of a tensor.

        Args:
            name: Name of the tensor.
            param: The tensor.
            adam: Moments and step counts.
            rows: [R] int32 row numbers without duplicates. If `rows` is None, all rows are updated,
                and no step remains deferred.
        """
        self.finish(name)
        behind = self._behind.get(name)
        if behind is None:
            return
        if behind.count and (rows is None or len(rows)):
            from crossgrad_core.numerics.jobs import Begun
            from crossgrad_core.training.adam.numba_kernels.late import catch_up

            # Always pass an int32 array, because another type would compile the kernel again.
            which = np.empty(0, np.int32) if rows is None else rows.numpy()
            flat, width = _flat(name, param, adam), _width(param)
            steps, before = behind.table, behind.before
            whole = rows is None
            done = behind.done
            arrays = flat[0], flat[1], flat[2], done, before, steps
            self._under_way[name] = Begun(catch_up, whole, which, width, *arrays)
            self.finish(name)
            _changed(name, param, adam)
        if rows is None:
            del self._behind[name]


def _flat(name: str, param: Tensor, adam: AdamState) -> tuple[NDArray[np.float32], ...]:
    """Return the tensor and its two moments as one-dimensional arrays."""
    tensors = (param, adam.exp_avg[name], adam.exp_avg_sq[name])
    return tuple(tensor.detach().view(-1).numpy() for tensor in tensors)


def _width(param: Tensor) -> int:
    """Return the number of elements in a row of the tensor."""
    return param.numel() // max(1, param.shape[0])


def _changed(name: str, param: Tensor, adam: AdamState) -> None:
    """Tell autograd that NumPy has changed the tensor and its moments."""
    for tensor in (param, adam.exp_avg[name], adam.exp_avg_sq[name]):
        torch.autograd.graph.increment_version(tensor)

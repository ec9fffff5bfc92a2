"""Deferred Adam steps: rows that no view of a step rendered take their step later, when needed.

Such a row has a gradient of zero, but Adam still moves it by its decaying moments. The deferred
steps are applied row by row when the row is next rendered, or to all rows when the tensor is read.
The deferred steps use the same float32 operations in the same order, so the bits are the same as
without deferral.

Steps run in the background on other threads while this thread continues with serial work. Code that
reads the tensor, for a render or on request, waits until the step is complete.
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

#: Largest number of deferred steps of a row, so that tables stay short.
LONGEST: Final = 256
#: If at least this share of the rows takes a step, all rows take it in memory order, because
#: deferred updates would take longer.
MOST_ROWS: Final = 0.15
#: With a smaller beta2, second moments may vanish before the kernel checks again.
LEAST_BETA2: Final = 0.5


@dataclass(eq=False)
class _Behind:
    """The deferred steps of one tensor.

    Attributes:
        done: [N] number of steps that each row has taken.
        before: Number of steps before the first step in `room`; every row has taken these steps.
        room: [LONGEST, 5] both betas, step size, scale of the root and eps of each later step.
        count: Number of steps in `room`.
    """

    done: NDArray[np.int32]
    before: int
    room: NDArray[np.float32] = field(default_factory=lambda: np.empty((LONGEST, 5), np.float32))
    count: int = 0

    def add(self, *numbers: float) -> None:
        """Add a step."""
        self.room[self.count] = numbers
        self.count += 1
        vars(self).pop("table", None)

    @cached_property
    def table(self) -> NDArray[np.float32]:
        """The steps as a flat table for the kernel."""
        steps = self.room[: self.count]
        # Upper and lower bounds over each step and all later steps.
        later = steps[::-1]
        most = np.maximum.accumulate(later[:, 2])[::-1]
        least = np.minimum.accumulate(later[:, 3])[::-1]
        # The bound is valid under two conditions: the first moment decays faster than the root of
        # the second moment, and the second moment stays a normal number between two checks.
        beta1, beta2 = steps[:, 0], steps[:, 1]
        fades = bool(((beta1 <= np.sqrt(beta2)) & (beta2 >= LEAST_BETA2)).all())
        most = most if fades else np.full_like(most, inf)
        return np.column_stack([steps, most, least]).astype(np.float32).ravel()


class Late:
    """The deferred steps of rows of tensors, by tensor name."""

    def __init__(self) -> None:
        self._behind: dict[str, _Behind] = {}
        self._under_way: dict[str, Begun] = {}

    @property
    def names(self) -> frozenset[str]:
        """The tensors with deferred steps of rows, or with a step that still runs."""
        return frozenset(self._behind).union(self._under_way)

    def finish(self, name: str | None = None) -> None:
        """Wait until no step is running; deferred steps remain deferred.

        Args:
            name: The tensor; None means all tensors.
        """
        for tensor_name in [name] if name is not None else list(self._under_way):
            if (begun := self._under_way.get(tensor_name)) is not None:
                # Keep the failed step, so that it raises its error again.
                begun.end()
                del self._under_way[tensor_name]

    def forget(self) -> None:
        """Discard all steps; no thread changes a tensor after the return."""
        for begun in self._under_way.values():
            begun.leave()
        self._under_way, self._behind = {}, {}

    def step(
        self, name: str, param: Tensor, grad: Tensor, adam: AdamState, step: Coefficients
    ) -> None:
        """Take a step with the rows of `grad` (sparse) and defer the step of all other rows.

        If `grad` contains many rows, all rows take the step and no row is deferred. The step may
        still run after the return; `finish` waits for it.

        Args:
            name: Name of the tensor; its count in `adam` includes this step.
            param: The tensor, float32 and contiguous, on the CPU.
            grad: The sparse gradient, which must not change any more.
            adam: Moments and counts.
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
        """Apply the deferred steps of rows of a tensor.

        Args:
            name: Name of the tensor.
            param: The tensor.
            adam: Moments and counts.
            rows: [R] int32 without duplicates; None means all rows; then no step remains deferred.
        """
        self.finish(name)
        behind = self._behind.get(name)
        if behind is None:
            return
        if behind.count and (rows is None or len(rows)):
            from crossgrad_core.numerics.jobs import Begun
            from crossgrad_core.training.adam.numba_kernels.late import catch_up

            # Always use the same type, because another type would compile the kernel again.
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
    """Return the tensor and its moments as flat arrays."""
    tensors = (param, adam.exp_avg[name], adam.exp_avg_sq[name])
    return tuple(tensor.detach().view(-1).numpy() for tensor in tensors)


def _width(param: Tensor) -> int:
    """Return the number of elements of a row."""
    return param.numel() // max(1, param.shape[0])


def _changed(name: str, param: Tensor, adam: AdamState) -> None:
    """Invalidate graphs that contain the old values, because NumPy wrote without autograd."""
    for tensor in (param, adam.exp_avg[name], adam.exp_avg_sq[name]):
        torch.autograd.graph.increment_version(tensor)

"""Steps of Adam put off for rows that no view of a step drew, and caught up with when needed.

Such a row has a gradient of zero; Adam moves it all the same, by moments that fade. What it is
behind with is done row by row when the row is next drawn, or all at once when somebody reads the
tensor, by the same float32 operations in the same order: the bits are those of steps taken at once.

Steps that are taken are under way for a while: nobody reads such a tensor before it is drawn or
asked for, so that the other threads work on it while this one does what one thread alone can do.
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

#: Steps that a row may be late with: tables stay short.
LONGEST: Final = 256
#: Share of the rows from which on a step is taken with all of them, in the order of memory: to
#: bring those left out up to date later takes longer.
MOST_ROWS: Final = 0.15
#: Second moments that fade faster may be gone before the kernel looks again.
LEAST_BETA2: Final = 0.5


@dataclass(eq=False)
class _Behind:
    """The rows of one tensor.

    Attributes:
        done: [N] steps that each row has had.
        before: Steps before the first of `room`; no row has had fewer.
        room: [LONGEST, 5] both betas, step size, scale of the root and eps of each step since.
        count: Steps since.
    """

    done: NDArray[np.int32]
    before: int
    room: NDArray[np.float32] = field(default_factory=lambda: np.empty((LONGEST, 5), np.float32))
    count: int = 0

    def add(self, *numbers: float) -> None:
        """Adds a step."""
        self.room[self.count] = numbers
        self.count += 1
        vars(self).pop("table", None)

    @cached_property
    def table(self) -> NDArray[np.float32]:
        """The steps as the kernel wants them, flat."""
        steps = self.room[: self.count]
        # What is above this step or below it from here on.
        later = steps[::-1]
        most = np.maximum.accumulate(later[:, 2])[::-1]
        least = np.minimum.accumulate(later[:, 3])[::-1]
        # Unless the first moment fades faster than the root of the second, and that slowly enough
        # to stay a normal number between two looks, nothing is known of what is to come.
        beta1, beta2 = steps[:, 0], steps[:, 1]
        fades = bool(((beta1 <= np.sqrt(beta2)) & (beta2 >= LEAST_BETA2)).all())
        most = most if fades else np.full_like(most, inf)
        return np.column_stack([steps, most, least]).astype(np.float32).ravel()


class Late:
    """The steps that rows of tensors are behind with, by tensor name; empty if nothing is late."""

    def __init__(self) -> None:
        self._behind: dict[str, _Behind] = {}
        self._under_way: dict[str, Begun] = {}

    @property
    def names(self) -> frozenset[str]:
        """The tensors of which rows may be behind, or which a step is changing."""
        return frozenset(self._behind).union(self._under_way)

    def finish(self, name: str | None = None) -> None:
        """Returns when no step is under way any more; rows that are late stay so.

        Args:
            name: The tensor; None: all.
        """
        for each in [name] if name is not None else list(self._under_way):
            if (begun := self._under_way.get(each)) is not None:
                # One that fails is no step, and stays to fail again.
                begun.end()
                del self._under_way[each]

    def forget(self) -> None:
        """Forgets all steps; nobody changes a tensor any more when this returns."""
        for begun in self._under_way.values():
            begun.leave()
        self._under_way, self._behind = {}, {}

    def step(
        self, name: str, param: Tensor, grad: Tensor, adam: AdamState, step: Coefficients
    ) -> None:
        """Takes a step with the rows that `grad` (sparse) has; the others are late from now on.

        Where it has many rows, the step is taken with all of them, and none is late. It may be
        under way when this returns (`finish`).

        Args:
            name: Name of the tensor; its count in `adam` includes this step.
            param: The tensor, float32 and contiguous, on the CPU.
            grad: Its gradient by rows, which nobody changes any more.
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
        """Takes the steps that rows of a tensor are behind.

        Args:
            name: Name of the tensor.
            param: The tensor.
            adam: Moments and counts.
            rows: [R] int32, each once; None: all, and nothing of the tensor is late any more.
        """
        self.finish(name)
        behind = self._behind.get(name)
        if behind is None:
            return
        if behind.count and (rows is None or len(rows)):
            from crossgrad_core.numerics.jobs import Begun
            from crossgrad_core.training.adam.numba_kernels.late import catch_up

            # Of one type in any case: for another one the kernel would be compiled once more.
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
    """The tensor and its moments, flat."""
    tensors = (param, adam.exp_avg[name], adam.exp_avg_sq[name])
    return tuple(tensor.detach().view(-1).numpy() for tensor in tensors)


def _width(param: Tensor) -> int:
    """Elements of a row."""
    return param.numel() // max(1, param.shape[0])


def _changed(name: str, param: Tensor, adam: AdamState) -> None:
    """Lets graphs that hold the old values notice that NumPy wrote behind autograd's back."""
    for tensor in (param, adam.exp_avg[name], adam.exp_avg_sq[name]):
        torch.autograd.graph.increment_version(tensor)

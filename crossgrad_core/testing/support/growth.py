"""Measure the costs of a plugin: the size of its state, the time of its hooks, and its memory.

The size of a state may depend on the number of views, on the number of primitives, and on a window
of recent steps. A state must not grow with every step, because each checkpoint would be larger than
the previous checkpoint.
"""

import gc
import tracemalloc
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from itertools import islice
from time import perf_counter

import pluggy
from torch import Tensor

from crossgrad_core.contract.blocks import PluginState
from crossgrad_core.testing.support.contract import require

#: Number of steps that `require_bounded` checks first. The check passes if the state does not grow
#: in the second half of these steps.
_FEW = 16
#: If the state grows, `require_bounded` compares the largest sizes in three windows. Each window
#: has this number of steps. A state that stores fewer recent steps than this number stops growing
#: in the first window.
_WINDOW = 1000


def size_of(state: PluginState) -> int:
    """Return the number of numbers, letters and names in a state.

    Of a per-primitive tensor, only one row is counted.
    """
    rows = sum(tensor[:1].numel() for tensor in state.per_primitive.values())
    return _size(state.values) + sum(tensor.numel() for tensor in state.tensors.values()) + rows


def _size(value: object) -> int:
    if isinstance(value, str):
        return len(value)
    if isinstance(value, Mapping):
        return sum(_size(name) + _size(item) for name, item in value.items())
    if isinstance(value, list | tuple):
        return sum(map(_size, value))
    return 1


def require_bounded(sizes: Iterable[int], method: str) -> None:
    """Require that the state of a run stops growing after some steps.

    Args:
        sizes: Size of the state after each step of a long run. The iterable computes a size only on
            demand.
        method: Name of the method that returns the state.
    """
    steps = iter(sizes)
    first, second = _largest(steps, _FEW // 2), _largest(steps, _FEW // 2)
    if second <= first:
        return
    later = [_largest(steps, _WINDOW) for _ in range(3)]
    require(
        not later[0] < later[1] < later[2],
        f"the state that {method} returns grows without limit: it contains "
        f"{later[0]:,} numbers after {_FEW + _WINDOW:,} steps and {later[2]:,} after "
        f"{_FEW + 3 * _WINDOW:,}; expected a size that does not depend on the number "
        "of steps: keep sums, or a window of the last steps",
    )


def _largest(sizes: Iterator[int], steps: int) -> int:
    return max(islice(sizes, steps))


def time_hooks(manager: pluggy.PluginManager, seconds: dict[str, float]) -> None:
    """From now on, record the wall time of the fastest call of each hook in `seconds`."""
    begun: list[float] = []

    def before(*_: object) -> None:
        begun.append(perf_counter())

    def after(_: object, name: str, *__: object) -> None:
        taken = perf_counter() - begun.pop()
        seconds[name] = min(taken, seconds.get(name, taken))

    manager.add_hookcall_monitoring(before, after)


@contextmanager
def traced_memory() -> Iterator[Callable[[], int]]:
    """Yield a function that returns the bytes allocated by Python, NumPy and torch tensors."""
    traced = tracemalloc.is_tracing()
    if not traced:
        tracemalloc.start()
    try:
        yield lambda: _tensors() + tracemalloc.get_traced_memory()[0]
    finally:
        if not traced:
            tracemalloc.stop()


def _tensors() -> int:
    """Return the bytes of all existing tensors. tracemalloc does not record torch's allocations."""
    gc.collect()
    storages = {}
    for candidate in gc.get_objects():
        # Do not use `isinstance`, because `isinstance` makes some objects emit warnings.
        if issubclass(type(candidate), Tensor) and not candidate.is_sparse:
            storage = candidate.untyped_storage()
            storages[storage.data_ptr()] = storage.nbytes()
    return sum(storages.values())

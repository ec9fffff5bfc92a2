"""The cost of hooks: the time of their calls, and the memory that is kept after them."""

import gc
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import perf_counter

import pluggy
from torch import Tensor


def time_hooks(manager: pluggy.PluginManager, seconds: dict[str, float]) -> None:
    """Writes the wall time of the fastest call of each hook into `seconds`, as calls are made."""
    begun: list[float] = []

    def before(*_: object) -> None:
        begun.append(perf_counter())

    def after(_: object, name: str, *__: object) -> None:
        taken = perf_counter() - begun.pop()
        seconds[name] = min(taken, seconds.get(name, taken))

    manager.add_hookcall_monitoring(before, after)


@contextmanager
def traced_memory() -> Iterator[Callable[[], int]]:
    """Gives a function that says how many bytes are held by Python, NumPy and tensors."""
    traced = tracemalloc.is_tracing()
    if not traced:
        tracemalloc.start()
    try:
        yield lambda: _tensors() + tracemalloc.get_traced_memory()[0]
    finally:
        if not traced:
            tracemalloc.stop()


def _tensors() -> int:
    """Bytes of all tensors that are alive; torch allocates them where Python does not look."""
    gc.collect()
    storages = {}
    for each in gc.get_objects():
        # Not `isinstance`, which asks objects that answer with warnings.
        if issubclass(type(each), Tensor) and not each.is_sparse:
            storage = each.untyped_storage()
            storages[storage.data_ptr()] = storage.nbytes()
    return sum(storages.values())

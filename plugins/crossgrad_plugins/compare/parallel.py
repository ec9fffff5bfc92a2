"""Figures that are drawn at the same time."""

import os
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import TypeVar

_Drawn = TypeVar("_Drawn")

#: Drawing is done by one process alone below so many cores.
_LEAST = 2


def in_parallel(drawings: Sequence[Callable[[], _Drawn]]) -> list[_Drawn]:
    """What the drawings make, in their order.

    Matplotlib holds Python's lock, so that only processes help. They are forked, as starting them
    anew would take longer than what is won: on Linux, where nothing else runs in this one.

    Args:
        drawings: Functions of modules with their arguments; both are pickled.
    """
    cores = len(os.sched_getaffinity(0)) if sys.platform == "linux" else 1
    if cores < _LEAST or threading.active_count() > 1:
        return [draw() for draw in drawings]
    workers = min(cores, len(drawings))
    with ProcessPoolExecutor(workers, mp_context=get_context("fork")) as pool:
        return [future.result() for future in [pool.submit(draw) for draw in drawings]]

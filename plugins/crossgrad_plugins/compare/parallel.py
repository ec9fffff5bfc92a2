"""Figures that are drawn at the same time."""

import signal
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from typing import TypeVar

from crossgrad_core.commands import available_cores

_Drawn = TypeVar("_Drawn")


def in_parallel(drawings: Sequence[Callable[[], _Drawn]]) -> list[_Drawn]:
    """What the drawings make, in their order.

    Matplotlib holds Python's lock, so that only processes help. They are forked, as starting them
    anew would take longer than what is won: on Linux, where nothing else runs in this one.

    Args:
        drawings: Functions of modules with their arguments; both are pickled.
    """
    workers = min(len(available_cores()), len(drawings)) if sys.platform == "linux" else 1
    if workers == 1 or threading.active_count() > 1:
        return [draw() for draw in drawings]
    # Ctrl-C reaches every process of a terminal: this one alone says that it was interrupted.
    quiet = partial(signal.signal, signal.SIGINT, signal.SIG_IGN)
    with ProcessPoolExecutor(workers, mp_context=get_context("fork"), initializer=quiet) as pool:
        return [future.result() for future in [pool.submit(draw) for draw in drawings]]

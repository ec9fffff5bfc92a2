"""Figures that are drawn at the same time."""

import ctypes
import os
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from typing import Final, TypeVar

from crossgrad_core.commands import available_cores

_Drawn = TypeVar("_Drawn")
#: Of Linux's prctl: the signal that a process gets when its parent is gone.
_PARENT_GONE: Final = 1


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
    begin = partial(_begin, os.getpid())
    with ProcessPoolExecutor(workers, mp_context=get_context("fork"), initializer=begin) as pool:
        return [future.result() for future in [pool.submit(draw) for draw in drawings]]


def _begin(parent: int) -> None:
    """In a worker, before it draws.

    A worker holds both ends of the queue that it waits at, so that it would wait for ever for a
    parent that was killed, or that ended at once.
    """
    # Ctrl-C reaches every process of a terminal: the parent alone says that it was interrupted.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    ctypes.CDLL(None).prctl(_PARENT_GONE, signal.SIGKILL)
    if os.getppid() != parent:  # It was gone before it could be followed.
        os._exit(1)

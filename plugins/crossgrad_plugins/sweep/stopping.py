"""Ctrl-C, `kill` and a closed terminal: a sweep stops its runs with checkpoints."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from crossgrad_core.commands import signal_names, tell
from crossgrad_plugins.sweep.engines import Stop

_WORDS = "stopping: the runs under way save a checkpoint first (once more: without an evaluation)"


@contextmanager
def noted(stop: Stop) -> Iterator[list[int]]:
    """Counts signals inside the block.

    Yields:
        The signals that came.
    """
    came: list[int] = []

    def note(number: int, _frame: FrameType | None) -> None:
        came.append(number)
        stop.count += 1
        if stop.count == 1:
            tell(_WORDS)

    before = {number: signal.signal(number, note) for number in signal_names()}
    try:
        yield came
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)

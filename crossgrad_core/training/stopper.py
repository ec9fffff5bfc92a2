"""Signals as requests: stop after the step, then without what takes time, then at once."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import FrameType
from typing import Any

from crossgrad_core.system.interrupts import end_at_once, signal_names, tell

#: What the user is told at the first and at the second signal; the third one ends the process.
_WORDS = (
    "stopping: what there is gets saved and evaluated first (once more: only saved)",
    "stopping: what there is gets saved first (once more: ends at once)",
)


@dataclass
class Stopper:
    """Whether and why a run is to stop.

    Attributes:
        signal: Number of the first signal; None where there was none.
        at_once: Whether a second one came: what only takes time is left out.
        error: What was found beside training and ends it; None where nothing was.
    """

    signal: int | None = None
    at_once: bool = False
    error: Exception | None = None
    _interruptible: bool = field(default=False, repr=False)
    _count: int = field(default=0, repr=False)
    _before: dict[int, Any] = field(default_factory=dict, repr=False)

    @property
    def requested(self) -> bool:
        """Whether training is to stop after the step under way."""
        return self.signal is not None or self.error is not None

    def fail(self, error: Exception) -> None:
        """Asks the run to end after its step because of an error found beside it, in any thread."""
        self.error = error

    @contextmanager
    def installed(self) -> Iterator["Stopper"]:
        """Handles signals inside the block; does nothing outside the main thread.

        A signal that the process was told to ignore (`nohup`, a job in the background) stays so.
        """
        before = self._before
        try:
            for number in signal_names():
                before[number] = signal.signal(number, self._handle)
        except ValueError:  # Signals can be handled in the main thread only.
            yield self
            return
        try:
            yield self
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    @contextmanager
    def interruptible(self) -> Iterator[None]:
        """Inside the block a second signal raises KeyboardInterrupt; elsewhere it is only noted."""
        self._interruptible = not self.at_once
        try:
            yield
        finally:
            self._interruptible = False

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self._count += 1
        if self._count > len(_WORDS):
            self._end(number, frame)
        tell(_WORDS[self._count - 1])
        if self.signal is None:
            self.signal = number
            return
        self.at_once = True
        if self._interruptible:
            self._interruptible = False
            raise KeyboardInterrupt

    def _end(self, number: int, frame: FrameType | None) -> None:
        """Leaves the end to the previous handler of signals; in Python itself an exception."""
        before = self._before.get(number)
        (before if callable(before) else end_at_once)(number, frame)
        raise KeyboardInterrupt

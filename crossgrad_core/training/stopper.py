"""Signals as requests: the first one stops a run after its step, the second one at once."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import FrameType

#: What asks a run to stop: the keyboard, a batch system, a terminal that closes.
_NAMES = ("SIGINT", "SIGTERM", "SIGHUP")


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

    @property
    def requested(self) -> bool:
        """Whether training is to stop after the step under way."""
        return self.signal is not None or self.error is not None

    @contextmanager
    def installed(self) -> Iterator["Stopper"]:
        """Handles signals inside the block; does nothing outside the main thread.

        A signal that the process was told to ignore (`nohup`, a job in the background) stays so.
        """
        before = {}
        try:
            for number in _signals():
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
        if self.signal is None:
            self.signal = number
            return
        self.at_once = True
        if self._interruptible:
            self._interruptible = False
            raise KeyboardInterrupt


def _signals() -> list[int]:
    known = [getattr(signal, name) for name in _NAMES if hasattr(signal, name)]
    return [number for number in known if signal.getsignal(number) is not signal.SIG_IGN]

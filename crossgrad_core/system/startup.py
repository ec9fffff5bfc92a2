"""Progress of a command: a line for each stage, a clock while kernels compile, counts.

Listens to the log of the package; what takes long says so there (`reading scene ...`), and so does
the cache of kernels before it compiles one. Nothing heavy is imported.
"""

import logging
import sys
from threading import Event, Thread
from time import monotonic
from typing import Final

from typing_extensions import override

from crossgrad_core.system.terminal import controls_of, is_live
from crossgrad_core.system.version import VERSION
from crossgrad_core.wording import one_line

#: The logger that speaks of kernels, and how its messages begin.
KERNELS: Final = "crossgrad_core.numerics.kernel_cache"
#: Seconds between lines about compiling where stderr is no terminal, and where it is one.
PLAIN_INTERVAL, TERMINAL_INTERVAL = 60.0, 1.0
_PACKAGE = "crossgrad_core"
_EXPLANATION = "compiling for this machine, before the first start only (about a minute)"


def announce(*, quiet: bool = False) -> None:
    """Says at once that the command has started, and from now on what it does.

    Args:
        quiet: Only warnings are shown.
    """
    finish()
    logger = logging.getLogger(_PACKAGE)
    level = logging.WARNING if quiet else logging.DEBUG
    logger.addHandler(_Startup(level))
    logger.setLevel(level)
    logger.info("crossgrad %s: loading libraries", VERSION)


def finish() -> None:
    """Ends what `announce` began, before a result or an error is shown."""
    logger = logging.getLogger(_PACKAGE)
    for handler in [each for each in logger.handlers if isinstance(each, _Startup)]:
        handler.close()
        logger.removeHandler(handler)
        logger.setLevel(logging.NOTSET)


class _Startup(logging.Handler):
    """Shows stages as lines, and compiling with the seconds that it has taken."""

    def __init__(self, level: int) -> None:
        super().__init__(level)
        self._compiling = _Compiling()

    @override
    def emit(self, record: logging.LogRecord) -> None:
        """Shows a record."""
        text = record.getMessage()
        if record.levelno >= logging.WARNING:
            _say(f"note: {text}")
        elif record.name != KERNELS:
            self._compiling.end()
            if record.levelno >= logging.INFO:
                _say(text)
        elif text.startswith("compiling "):
            self._compiling.begin()
        else:
            self._compiling.done()

    @override
    def close(self) -> None:
        """Says nothing more."""
        self._compiling.stop()
        super().close()


class _Compiling:
    """Shows the seconds of compiling, from a thread, because one kernel may take ten seconds.

    On a terminal all is one line. A kernel that another one calls is compiled inside it.
    """

    def __init__(self) -> None:
        self._depth, self._seconds, self._began = 0, 0.0, 0.0
        self._over = Event()
        self._thread: Thread | None = None

    def begin(self) -> None:
        """A kernel is going to be compiled."""
        if self._thread is None:
            _say(_EXPLANATION, stays=not is_live(sys.stderr))
            self._over.clear()
            self._thread = Thread(target=self._tell, name="crossgrad-startup", daemon=True)
            self._thread.start()
        if not self._depth:
            self._began = monotonic()
        self._depth += 1

    def done(self) -> None:
        """The kernel that began last is compiled."""
        self._depth -= 1
        if not self._depth:
            self._seconds += monotonic() - self._began

    def end(self) -> None:
        """Say what all kernels took."""
        if not self.stop():
            return
        _say(f"compiled in {self._seconds:.0f} s")
        self._seconds = 0.0

    def stop(self) -> bool:
        """End the clock; return whether there was one."""
        if self._thread is None:
            return False
        self._over.set()
        self._thread.join()
        self._thread = None
        return True

    def _tell(self) -> None:
        terminal = is_live(sys.stderr)
        while not self._over.wait(TERMINAL_INTERVAL if terminal else PLAIN_INTERVAL):
            if self._depth:
                seconds = self._seconds + monotonic() - self._began
                _say(f"{_EXPLANATION}: {seconds:.0f} s", stays=not terminal)


def _say(text: str, *, stays: bool = True) -> None:
    """Writes a line; one that does not stay is overwritten by the next."""
    clear = "\r\x1b[K" if is_live(sys.stderr) else ""
    try:
        stream = controls_of(sys.stderr)
        stream.write(f"{clear}{one_line(text)}" + ("\n" if stays else ""))
        stream.flush()
    except (OSError, ValueError):
        pass  # It is no longer read.


class Progress:
    """Lines on stderr that begin with three dots, one at most in so many seconds.

    Args:
        pause: Seconds between two lines; 0 shows all of them. A pause begins at once.
    """

    def __init__(self, pause: float = 0.0) -> None:
        self._pause = pause
        self._last = monotonic()

    @property
    def due(self) -> bool:
        """Whether a line would be shown now, for texts that take long to make."""
        return monotonic() - self._last >= self._pause

    def tell(self, text: str) -> None:
        """Shows a line where one is due."""
        if self.due:
            self._last = monotonic()
            sys.stderr.write(f"... {one_line(text)}\n")
            sys.stderr.flush()

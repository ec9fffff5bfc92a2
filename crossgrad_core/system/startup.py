"""Progress of a command: a line for each stage, and a clock while kernels compile.

This module shows log messages of the package. Slow stages log a message such as `reading scene
...`, and the kernel cache logs a message before it compiles a kernel. This module imports no large
package.
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

#: The logger of the kernel cache.
KERNELS: Final = "crossgrad_core.numerics.kernel_cache"
#: Seconds between messages about compilation: first for output that is not a terminal, then for a
#: terminal.
PLAIN_INTERVAL, TERMINAL_INTERVAL = 60.0, 1.0
_PACKAGE = "crossgrad_core"
_EXPLANATION = "compiling for this machine, only before the first start (about a minute)"


def announce(*, quiet: bool = False) -> None:
    """Report that the command has started, and report its stages until `finish` is called.

    Args:
        quiet: Show only warnings.
    """
    finish()
    logger = logging.getLogger(_PACKAGE)
    level = logging.WARNING if quiet else logging.DEBUG
    logger.addHandler(_Startup(level))
    logger.setLevel(level)
    logger.info("crossgrad %s: loading libraries", VERSION)


def finish() -> None:
    """End the reports that `announce` began, before a result or an error is shown."""
    logger = logging.getLogger(_PACKAGE)
    for handler in [handler for handler in logger.handlers if isinstance(handler, _Startup)]:
        handler.close()
        logger.removeHandler(handler)
        logger.setLevel(logging.NOTSET)


class _Startup(logging.Handler):
    """A log handler that shows a line for each stage, and the compilation time so far."""

    def __init__(self, level: int) -> None:
        super().__init__(level)
        self._compiling = _Compiling()

    @override
    def emit(self, record: logging.LogRecord) -> None:
        """Show a log record."""
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
        """Stop all output."""
        self._compiling.stop()
        super().close()


class _Compiling:
    """A clock of compilation that runs in a thread, because one kernel may take ten seconds.

    On a terminal, the clock uses a single line. The compilation of a kernel may include the
    compilation of other kernels.
    """

    def __init__(self) -> None:
        self._depth, self._seconds, self._began = 0, 0.0, 0.0
        self._over = Event()
        self._thread: Thread | None = None

    def begin(self) -> None:
        """Record that the compilation of a kernel begins."""
        if self._thread is None:
            _say(_EXPLANATION, stays=not is_live(sys.stderr))
            self._over.clear()
            self._thread = Thread(target=self._tell, name="crossgrad-startup", daemon=True)
            self._thread.start()
        if not self._depth:
            self._began = monotonic()
        self._depth += 1

    def done(self) -> None:
        """Record that the compilation that began last is complete."""
        self._depth -= 1
        if not self._depth:
            self._seconds += monotonic() - self._began

    def end(self) -> None:
        """Show the total compilation time of all kernels."""
        if not self.stop():
            return
        _say(f"compiled in {self._seconds:.0f} s")
        self._seconds = 0.0

    def stop(self) -> bool:
        """End the clock; return True if the clock was running."""
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
    """Write a line; the next line overwrites this line unless `stays` is True."""
    clear = "\r\x1b[K" if is_live(sys.stderr) else ""
    try:
        stream = controls_of(sys.stderr)
        stream.write(f"{clear}{one_line(text)}" + ("\n" if stays else ""))
        stream.flush()
    except (OSError, ValueError):
        pass  # The program that reads the output has closed the stream.


class Progress:
    """A writer of progress lines on stderr that begin with three dots, at most one per pause.

    Args:
        pause: Seconds between two lines; 0 shows all lines. The first pause begins immediately.
    """

    def __init__(self, pause: float = 0.0) -> None:
        self._pause = pause
        self._last = monotonic()

    @property
    def due(self) -> bool:
        """True if the pause is over, so that `tell` would show a line now."""
        return monotonic() - self._last >= self._pause

    def tell(self, text: str) -> None:
        """Show a line if the pause is over."""
        if self.due:
            self._last = monotonic()
            sys.stderr.write(f"... {one_line(text)}\n")
            sys.stderr.flush()

"""Progress before a command's first result: a line for each stage, kernels with a clock.

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
#: Seconds between lines about kernels where stderr is no terminal, and where it is one.
PLAIN_INTERVAL, TERMINAL_INTERVAL = 10.0, 1.0
_PACKAGE = "crossgrad_core"
_EXPLANATION = (
    "compiling kernels for this machine: only before the first start with these parts, usually "
    "within a minute"
)


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
        self._kernels = _Kernels()

    @override
    def emit(self, record: logging.LogRecord) -> None:
        """Shows a record."""
        text = record.getMessage()
        if record.levelno >= logging.WARNING:
            _say(f"note: {text}")
        elif record.name != KERNELS:
            self._kernels.end()
            if record.levelno >= logging.INFO:
                _say(text)
        elif text.startswith("compiling "):
            self._kernels.begin(text.partition(" ")[2])
        else:
            self._kernels.done()

    @override
    def close(self) -> None:
        """Says nothing more."""
        self._kernels.stop()
        super().close()


class _Kernels:
    """Tells how long kernels have been compiled, from a thread: one of them may take ten seconds.

    A kernel that another one calls is compiled inside it.
    """

    def __init__(self) -> None:
        self._names: list[str] = []
        self._count, self._seconds, self._began = 0, 0.0, 0.0
        self._over = Event()
        self._thread: Thread | None = None

    def begin(self, name: str) -> None:
        """A kernel is going to be compiled."""
        if self._thread is None:
            _say(_EXPLANATION)
            self._over.clear()
            self._thread = Thread(target=self._tell, name="crossgrad-startup", daemon=True)
            self._thread.start()
        if not self._names:
            self._began = monotonic()
        self._names.append(name)
        self._count += 1

    def done(self) -> None:
        """The kernel that began last is compiled."""
        self._names = self._names[:-1]
        if not self._names:
            self._seconds += monotonic() - self._began

    def end(self) -> None:
        """Says what all of them took."""
        if not self.stop():
            return
        kernels = "kernel" if self._count == 1 else "kernels"
        _say(f"compiled {self._count} {kernels} in {self._seconds:.0f} s")
        self._count, self._seconds = 0, 0.0

    def stop(self) -> bool:
        """Ends the clock; whether there was one."""
        if self._thread is None:
            return False
        self._over.set()
        self._thread.join()
        self._thread = None
        return True

    def _tell(self) -> None:
        terminal = is_live(sys.stderr)
        while not self._over.wait(TERMINAL_INTERVAL if terminal else PLAIN_INTERVAL):
            if names := self._names:
                seconds = self._seconds + monotonic() - self._began
                text = f"  {seconds:.0f} s, kernel {self._count}: {names[0]}"
                _say(text, stays=not terminal)


def _say(text: str, *, stays: bool = True) -> None:
    """Writes a line; one that does not stay is overwritten by the next."""
    clear = "\r\x1b[K" if is_live(sys.stderr) else ""
    try:
        stream = controls_of(sys.stderr)
        stream.write(f"{clear}{one_line(text)}" + ("\n" if stays else ""))
        stream.flush()
    except (OSError, ValueError):
        pass  # It is no longer read.

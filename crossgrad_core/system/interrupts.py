"""Handling of Ctrl-C, `kill` and a closed terminal: the command prints one line and ends.

The exit code is 128 plus the signal's number, as a shell reports it: 130 after Ctrl-C, 143 after
SIGTERM, 129 after SIGHUP. The command imports this module first, so that a signal during later
imports is handled.
"""

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType

#: Signals that request the end of a command, if the system has them.
SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
#: Lines that tell the user how to continue after an immediate end. The newest line is last.
_WAYS_ON: list[str] = []
#: Files and folders that are being written. They are deleted if the process ends immediately.
UNFINISHED: set[str] = set()
#: Numbers of the processes that write unfinished files. These processes are ended before the files
#: are deleted.
HELPERS: set[int] = set()


def exit_code(number: int) -> int:
    """Return the exit code of a command that a signal ended."""
    return 128 + number


def signal_names() -> list[int]:
    """Return the signals that are not ignored; `nohup` and background jobs ignore some signals."""
    return [number for number in SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]


def tell(text: str, *, alone: bool = True) -> None:
    """Write one line to stderr; a signal handler may call this function.

    Args:
        text: The line.
        alone: True to start on a new line of a terminal, after "^C" or a progress bar.
    """
    line = f"\n{text}\n" if alone and sys.stderr.isatty() else f"{text}\n"
    try:
        sys.stderr.write(line)
        sys.stderr.flush()
    except RuntimeError:  # The signal arrived while another message was being written to stderr.
        with suppress(OSError):
            os.write(2, line.encode(errors="backslashreplace"))
    except (OSError, ValueError):
        pass  # Ignore the error, because the message cannot be shown anywhere else.


def end_at_once(number: int, _frame: FrameType | None) -> None:
    """End the process without an exception, because library code may suppress exceptions."""
    tell("interrupted" if number == signal.SIGINT else f"ended by {signal.Signals(number).name}")
    for line in _WAYS_ON[-1:]:
        tell(line, alone=False)
    with suppress(Exception):
        sys.stdout.flush()
    for helper in list(HELPERS):
        with suppress(OSError):
            os.kill(helper, signal.SIGTERM)
            os.waitpid(helper, 0)
    for path in list(UNFINISHED):
        with suppress(OSError):
            if os.path.isdir(path):
                import shutil  # Whoever writes a folder has imported it already.

                shutil.rmtree(path)
            else:
                os.unlink(path)
    os._exit(exit_code(number))


@contextmanager
def resume_hint(text: str) -> Iterator[None]:
    """Print a line of text if a signal ends the process immediately inside the block."""
    _WAYS_ON.append(text)
    try:
        yield
    finally:
        _WAYS_ON.remove(text)


@contextmanager
def ended_quietly() -> Iterator[None]:
    """Let a signal end the process at once.

    If the signal arrives inside the block, `end_at_once` handles it. If the signal arrives after
    the block, the process ends without a message. Signals that were ignored before the block are
    still ignored.
    """
    numbers = signal_names()
    for number in numbers:
        signal.signal(number, end_at_once)
    try:
        yield
    finally:
        # The process is about to exit, and Python's own handler would print a traceback.
        for number in numbers:
            signal.signal(number, signal.SIG_DFL)

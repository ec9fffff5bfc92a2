"""Ctrl-C, `kill` and a closed terminal end a command with one line, whatever it is doing.

The exit code is 128 and the signal's number, as a shell reports it: 130 after Ctrl-C, 143 after
SIGTERM, 129 after SIGHUP. This module is the first that the command imports, and imports little.
"""

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType

#: What asks a command to end, where the system has it.
SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
#: How to go on after an end at once: lines for the user, the newest last.
_WAYS_ON: list[str] = []
#: Files that are being written; they are deleted where the process ends at once.
UNFINISHED: set[str] = set()
#: Numbers of the processes that write such files; they end first.
HELPERS: set[int] = set()


def exit_code(number: int) -> int:
    """The exit code of a command that a signal ended."""
    return 128 + number


def signal_names() -> list[int]:
    """The signals that are not ignored; `nohup` and background jobs of scripts ignore some."""
    return [number for number in SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]


def tell(text: str, *, alone: bool = True) -> None:
    """Writes one line to stderr, from a signal handler too.

    Args:
        text: The line.
        alone: Whether the cursor of a terminal may stand behind "^C" or a progress bar.
    """
    line = f"\n{text}\n" if alone and sys.stderr.isatty() else f"{text}\n"
    try:
        sys.stderr.write(line)
        sys.stderr.flush()
    except RuntimeError:  # The handler came while stderr was being written to.
        with suppress(OSError):
            os.write(2, line.encode(errors="backslashreplace"))
    except (OSError, ValueError):
        pass  # There is nowhere left to say it.


def end_at_once(number: int, _frame: FrameType | None) -> None:
    """Ends the process without unwinding: an exception may be lost in a callback of a library."""
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
            os.unlink(path)
    os._exit(exit_code(number))


@contextmanager
def resume_hint(text: str) -> Iterator[None]:
    """Inside the block an end at once is followed by this line."""
    _WAYS_ON.append(text)
    try:
        yield
    finally:
        _WAYS_ON.remove(text)


@contextmanager
def ended_quietly() -> Iterator[None]:
    """Ends the process at once when it is asked to inside the block, and quietly after it."""
    numbers = signal_names()
    for number in numbers:
        signal.signal(number, end_at_once)
    try:
        yield
    finally:
        # Nothing is left to do but to leave; Python's own handler would print a traceback.
        for number in numbers:
            signal.signal(number, signal.SIG_DFL)

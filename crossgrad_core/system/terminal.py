"""Capabilities of a terminal."""

import os
from typing import TextIO


def shows_bar(stream: TextIO) -> bool:
    """Whether a progress bar can move on the stream: on a live terminal, and below a notebook cell.

    A notebook goes back to the start of a line, but knows no other sequence of a terminal.
    """
    return is_live(stream) or type(stream).__module__.startswith("ipykernel.")


def is_live(stream: TextIO) -> bool:
    """Whether the stream is a terminal on which a line can be overwritten.

    A terminal of no columns (`docker exec -t`, some editors and CI systems) has no room for a
    progress bar, and a dumb one cannot go back to the start of a line.
    """
    if not stream.isatty() or os.environ.get("TERM") == "dumb":
        return False
    try:
        return os.get_terminal_size(stream.fileno()).columns > 0
    except (OSError, ValueError):  # It does not tell its size.
        return True

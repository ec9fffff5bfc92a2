"""Capabilities of a terminal, and streams that show control characters as text."""

import io
import os
from typing import Any, TextIO, cast

from typing_extensions import override

from crossgrad_core.wording import showable


class PlainText(io.TextIOWrapper):
    """A text stream that writes control characters out, as Python does in a string.

    A name from a file could otherwise move the cursor or recolour the terminal. Code that moves the
    cursor itself writes to `controls_of` the stream.
    """

    def __init__(self, buffer: io.BufferedWriter, **options: Any) -> None:  # noqa: ANN401
        super().__init__(buffer, **options)
        self.controls = _Controls(self)

    @override
    def write(self, text: str, /) -> int:
        """Write the text with its control characters as escapes, line ends excepted."""
        return super().write(showable(text))


class _Controls:
    """The same stream for text with control characters."""

    def __init__(self, stream: PlainText) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write the text as it is."""
        return io.TextIOWrapper.write(self._stream, text)

    def __getattr__(self, name: str) -> object:
        return getattr(self._stream, name)


def controls_of(stream: TextIO) -> TextIO:
    """Return the stream to which control characters can be written."""
    return cast("TextIO", getattr(stream, "controls", stream))


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

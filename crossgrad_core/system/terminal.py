"""Capabilities of a terminal, and streams that show control characters as text."""

import io
import os
from typing import Any, TextIO, cast

from typing_extensions import override

from crossgrad_core.wording import showable


class PlainText(io.TextIOWrapper):
    """A text stream that writes control characters as escape sequences of Python strings.

    Otherwise a name from a file could move the cursor or change the colours of the terminal. Code
    that moves the cursor writes to the stream that `controls_of` returns.
    """

    def __init__(self, buffer: io.BufferedWriter, **options: Any) -> None:  # noqa: ANN401
        super().__init__(buffer, **options)
        self.controls = _Controls(self)

    @override
    def write(self, text: str, /) -> int:
        """Write the text with its control characters as escapes, except line ends."""
        return super().write(showable(text))


class _Controls:
    """A wrapper of a `PlainText` stream that writes control characters unchanged."""

    def __init__(self, stream: PlainText) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write the text unchanged."""
        return io.TextIOWrapper.write(self._stream, text)

    def __getattr__(self, name: str) -> object:
        return getattr(self._stream, name)


def controls_of(stream: TextIO) -> TextIO:
    """Return the stream to which control characters can be written."""
    return cast("TextIO", getattr(stream, "controls", stream))


def shows_bar(stream: TextIO) -> bool:
    """Return True if a progress bar can move on the stream: a live terminal or a notebook cell.

    A notebook can return to the start of a line, but supports no other terminal sequence.
    """
    return is_live(stream) or type(stream).__module__.startswith("ipykernel.")


def is_live(stream: TextIO) -> bool:
    """Return True if the stream is a terminal on which a line can be overwritten.

    A terminal with 0 columns (`docker exec -t`, some editors and CI systems) has no space for a
    progress bar. A dumb terminal cannot return to the start of a line.
    """
    if not stream.isatty() or os.environ.get("TERM") == "dumb":
        return False
    try:
        return os.get_terminal_size(stream.fileno()).columns > 0
    # Assume that a terminal without a known size can overwrite lines.
    except (OSError, ValueError):
        return True

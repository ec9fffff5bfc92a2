"""Standard streams whose failed writes do not end a command."""

import io
import os
import sys
from typing import TYPE_CHECKING, Final, TextIO

from typing_extensions import override

from crossgrad_core.system.terminal import PlainText

if TYPE_CHECKING:
    from typing_extensions import Buffer

_HIGHEST: Final = 2  # stderr


def outlast_readers() -> None:
    """Make stdout and stderr ignore failed writes and escape characters that cannot be shown.

    Otherwise a closed pipe (`| head`), a lost terminal or a full disk would end hours of training
    at the next progress line. A folder name with characters outside the terminal's encoding would
    also end the training. The messages of a run are also in its log.txt.
    """
    _occupy()
    sys.stdout = _lasting(sys.stdout)
    sys.stderr = _lasting(sys.stderr)


class _LastingFile(io.FileIO):
    """A file that accepts all content, even if the content cannot be written."""

    @override
    def write(self, content: "Buffer", /) -> int:
        """Write as much as possible, and report that everything was written."""
        try:
            written = super().write(content)
            if written is None:  # Another process changed the terminal to non-blocking mode.
                os.set_blocking(self.fileno(), True)
                written = super().write(content)
        except OSError:
            written = None
        return memoryview(content).nbytes if written is None else written


def _occupy() -> None:
    """Open the null device for each standard stream that the caller closed (`2>&-`).

    Otherwise the next opened file would get the stream's file descriptor. Messages of the program
    would then be written into this file.
    """
    while (number := os.open(os.devnull, os.O_RDWR)) <= _HIGHEST:
        pass
    os.close(number)


def _lasting(stream: TextIO | None) -> TextIO:
    """Return a stream that writes to the same file and ignores failed writes.

    Other kinds of streams, such as a Windows console, are returned unchanged.
    """
    if stream is None:
        return open(os.devnull, "w", encoding="utf-8")
    if not isinstance(stream, io.TextIOWrapper):
        return stream
    below = getattr(stream.buffer, "raw", stream.buffer)
    if type(below) is not io.FileIO:
        return stream
    file = _LastingFile(below.fileno(), "w", closefd=False)
    return PlainText(
        io.BufferedWriter(file),
        encoding=stream.encoding,
        errors="backslashreplace",
        line_buffering=stream.line_buffering,
        write_through=stream.write_through,
    )

"""Standard streams that end no command: a reader may leave, and text may not fit the encoding."""

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
    """Make stdout and stderr swallow what can no longer be read, and escape what is no plain text.

    A closed pipe (`| head`), a terminal that is gone or a full disk would otherwise end a training
    of hours at its next line of progress. So would the name of a folder that the encoding of the
    terminal lacks. What a run says stands in its log.txt as well.
    """
    _occupy()
    sys.stdout = _lasting(sys.stdout)
    sys.stderr = _lasting(sys.stderr)


class _LastingFile(io.FileIO):
    """A file that takes everything, whether or not it can be written."""

    @override
    def write(self, content: "Buffer", /) -> int:
        """Writes what can be written; of the rest it is said that it was."""
        try:
            written = super().write(content)
            if written is None:  # Another process of the terminal told it not to wait.
                os.set_blocking(self.fileno(), True)
                written = super().write(content)
        except OSError:
            written = None
        return memoryview(content).nbytes if written is None else written


def _occupy() -> None:
    """Opens the null device for each standard stream that the caller closed (`2>&-`).

    The next file that is opened would otherwise take its number, and get what is meant for it.
    """
    while (number := os.open(os.devnull, os.O_RDWR)) <= _HIGHEST:
        pass
    os.close(number)


def _lasting(stream: TextIO | None) -> TextIO:
    """Return a stream over the same file; one of another kind (a Windows console) as it is."""
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

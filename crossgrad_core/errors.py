"""The one error type that users see, and how it is worded."""

import re
from pathlib import Path
from typing import Final

#: Longest part of a message, and longest place; the middle of what is longer is left out.
LONGEST: Final = 500
LONGEST_PLACE: Final = 1000
# Control characters could move the cursor or recolour the terminal; lone surrogates stand for bytes
# that are not UTF-8, and cannot be written to a file.
_UNSHOWABLE = re.compile(r"[\x00-\x09\x0b-\x1f\x7f-\x9f\ud800-\udfff]")


class UserError(Exception):
    """Bad input from the user: reported as one message with exit code 2, never as a traceback.

    Args:
        what: What is wrong, as a sentence without a full stop.
        where: The file, option or plugin concerned.
        expected: What would have been right.
        found: What was there instead.
        todo: What the user can do about it.
    """

    def __init__(
        self, what: str, *, where: object = "", expected: str = "", found: str = "", todo: str = ""
    ) -> None:
        self.what = what
        self.where = str(where)
        self.expected = expected
        self.found = found
        self.todo = todo
        super().__init__(self.message())

    def message(self) -> str:
        """The error as indented lines: what, where, expected, found, what to do."""
        rows = (
            ("where", _shortened(self.where, LONGEST_PLACE)),
            ("expected", _shortened(self.expected)),
            ("found", _shortened(self.found)),
            ("to do", _shortened(self.todo)),
        )
        lines = [f"  {label + ':':<10}{text}" for label, text in rows if text]
        return _showable("\n".join([_shortened(self.what), *lines]))


def _shortened(text: str, longest: int = LONGEST) -> str:
    if len(text) <= longest:
        return text
    return f"{text[: longest // 2]} ... {text[-longest // 2 :]}"


def _showable(text: str) -> str:
    """Text from anybody's file as a terminal can show it."""
    return _UNSHOWABLE.sub(lambda match: ascii(match.group())[1:-1], text)


class IncompatibleSelectionError(UserError):
    """The selected components cannot work together; raised before training, with the reason."""


class RunFailedError(Exception):
    """Training failed; raised by `crossgrad_core.run` and `resume`. What there is was kept.

    Args:
        folder: The run's folder: results so far, log.txt, and checkpoints to go on from.
        error: What went wrong.
    """

    def __init__(self, folder: Path, error: str) -> None:
        self.folder = folder
        super().__init__(f"{error}\nwhat there is is kept in {folder}")

"""The error type for users, and the layout of its message."""

from pathlib import Path
from typing import Final

from crossgrad_core.wording import one_line, showable

#: Maximum number of characters in one part of a message, and in the part `where`. In a longer text,
#: the middle is left out.
LONGEST: Final = 500
LONGEST_PLACE: Final = 1000


class UserError(Exception):
    """Bad input from the user, which a command reports as one message with exit code 2.

    Args:
        what: The problem, as a sentence without a full stop.
        where: The file, option or plugin that the problem concerns.
        expected: The value that would have been correct.
        found: The value that was found instead.
        todo: The next step for the user.
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
        """Return the error as indented lines: what, where, expected, found, what to do."""
        rows = (
            ("where", _short(one_line(self.where), LONGEST_PLACE)),
            ("expected", _short(self.expected)),
            ("found", _short(self.found)),
            ("to do", _short(self.todo)),
        )
        lines = [f"  {label + ':':<10}{text}" for label, text in rows if text]
        return "\n".join([_short(self.what), *lines])


def _short(content: str, longest: int = LONGEST) -> str:
    """Return a part of a message, shortened after its control characters are escaped."""
    text = showable(content)
    if len(text) <= longest:
        return text
    return f"{text[: longest // 2]} ... {text[-longest // 2 :]}"


class IncompatibleSelectionError(UserError):
    """The selected components cannot work together; the error lists the reasons before training."""


class RunFailedError(Exception):
    """Training failed; the functions `crossgrad_core.run` and `resume` raise this error.

    Results that the run wrote before are kept.

    Args:
        folder: The run's folder, with the results so far, log.txt, and checkpoints to continue
            from.
        error: The reason of the failure.
    """

    def __init__(self, folder: Path, error: str) -> None:
        self.folder = folder
        super().__init__(f"{error}\nthe files that the run wrote are in {folder}")

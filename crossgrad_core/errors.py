"""The one error type that users see, and how it is worded."""


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
            ("where", self.where),
            ("expected", self.expected),
            ("found", self.found),
            ("to do", self.todo),
        )
        lines = [self.what] + [f"  {label + ':':<10}{text}" for label, text in rows if text]
        return "\n".join(lines)


class IncompatibleSelectionError(UserError):
    """The selected components cannot work together; raised before training, with the reason."""

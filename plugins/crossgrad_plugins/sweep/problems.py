"""All problems of a grid, in one error."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from typing_extensions import override

from crossgrad_core.commands import UserError

#: Maximum number of problems that are shown.
MOST = 20


@dataclass(frozen=True)
class Problem:
    """One problem of a grid.

    Attributes:
        place: The position in the grid.
        what: Description of the problem.
        hint: What the user can do; empty if unknown.
    """

    place: str
    what: str
    hint: str = ""

    @override
    def __str__(self) -> str:
        lines = self.what.splitlines() or [""]
        text = "\n".join([f"{self.place}: {lines[0]}", *(f"    {line}" for line in lines[1:])])
        return f"{text}; {self.hint}" if self.hint else text


class GridError(UserError):
    """The error for a grid, with all its problems.

    Args:
        problems: The problems.
        path: The grid's file.
    """

    def __init__(self, problems: Sequence[Problem], path: Path) -> None:
        self.problems = tuple(problems)
        super().__init__(
            f"the grid has {len(problems)} errors"
            if len(problems) > 1
            else "the grid has an error",
            where=path,
            todo="correct the grid and start again; no run was started",
        )

    @override
    def message(self) -> str:
        """Return the error, followed by the problems."""
        shown = [f"- {problem}" for problem in self.problems[:MOST]]
        more = len(self.problems) - len(shown)
        return "\n".join([super().message(), *shown, *([f"- and {more} more"] if more else [])])


def refuse(problems: Sequence[Problem], path: Path) -> None:
    """Raise an error if a grid has problems.

    Raises:
        GridError: There are problems.
    """
    if problems:
        raise GridError(problems, path)

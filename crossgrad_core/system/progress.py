"""Lines about how far a command is."""

import sys
from time import monotonic

from crossgrad_core.wording import one_line


class Progress:
    """Lines on stderr that begin with three dots, one at most in so many seconds.

    Args:
        pause: Seconds between two lines; 0 shows all of them. A pause begins at once.
    """

    def __init__(self, pause: float = 0.0) -> None:
        self._pause = pause
        self._last = monotonic()

    @property
    def due(self) -> bool:
        """Whether a line would be shown now, for texts that take long to make."""
        return monotonic() - self._last >= self._pause

    def tell(self, text: str) -> None:
        """Shows a line where one is due."""
        if self.due:
            self._last = monotonic()
            sys.stderr.write(f"... {one_line(text)}\n")
            sys.stderr.flush()

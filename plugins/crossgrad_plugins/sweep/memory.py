"""The bound on what one run may take, so that none takes the memory of the others."""

from dataclasses import dataclass
from pathlib import Path
from time import monotonic

#: Seconds between two looks.
_PAUSE = 1.0
_GIB = 2**30


@dataclass
class Bound:
    """Watches the memory of a process.

    Attributes:
        most: Bytes that it may take; None where there is no bound.
        taken: Bytes that it took when it was too much.
    """

    most: int | None
    taken: int = 0
    _looked: float = 0.0

    @property
    def exceeded(self) -> bool:
        """Whether it ever took too much."""
        return self.taken > 0

    @property
    def reason(self) -> str:
        """What is to be said then."""
        return (
            f"took {self.taken / _GIB:.1f} GiB, more than the {(self.most or 0) / _GIB:.1f} GiB of "
            "a run; start fewer --workers, or name more --memory"
        )

    def is_exceeded(self, process: int) -> bool:
        """Looks, once in a while, whether a process takes too much."""
        if self.most is None or monotonic() - self._looked < _PAUSE:
            return self.exceeded
        self._looked = monotonic()
        taken = resident_bytes(process)
        if taken is not None and taken > self.most:
            self.taken = taken
        return self.exceeded


def resident_bytes(process: int) -> int | None:
    """Memory that a process holds; None where the system does not say."""
    try:
        text = Path(f"/proc/{process}/status").read_text(encoding="ascii")
    except (OSError, UnicodeDecodeError):
        return None
    for line in text.splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) * 1024
    return None

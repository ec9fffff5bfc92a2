"""Where things are in the folder of a sweep."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Layout:
    """The folder of a sweep.

    Attributes:
        out: The folder.
    """

    out: Path

    def run(self, name: str) -> Path:
        """Results of a run, as `crossgrad run` writes them."""
        return self.out / "runs" / name

    def settings(self, name: str) -> Path:
        """What a run is started with."""
        return self.out / "settings" / f"{name}.yaml"

    def output(self, name: str) -> Path:
        """What the processes of a run printed."""
        return self.out / "output" / f"{name}.txt"

    @property
    def records(self) -> Path:
        """One file for each worker."""
        return self.out / "workers"

    @property
    def plan(self) -> Path:
        """Which run is what, as a table."""
        return self.out / "runs.csv"

    def make(self) -> None:
        """Makes the folders."""
        for path in ("runs", "settings", "output", "workers"):
            (self.out / path).mkdir(parents=True, exist_ok=True)

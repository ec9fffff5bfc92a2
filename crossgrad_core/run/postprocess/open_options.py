"""Options for opening a trained run."""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from crossgrad_core.run.load_run import opened
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState


class Opens(Protocol):
    """A function that opens a run."""

    def open(self, folder: Path) -> tuple[Setup, TrainState]:
        """Return the run's setup and its newest state."""
        ...


@dataclass(frozen=True)
class How:
    """Options for opening a run.

    Attributes:
        device: Device of the tensors; by default the device of the run.
        threads: Number of CPU threads; all by default.
        accept_scene: Accept a scene whose photos, masks, points or held-out views have changed.
    """

    device: str | None = None
    threads: int | None = None
    accept_scene: bool = False

    def open(self, folder: Path) -> tuple[Setup, TrainState]:
        """Return the run's setup and its newest state."""
        given = {"device": self.device, "threads": self.threads}
        machine = {name: value for name, value in given.items() if value is not None}
        return opened(folder, machine, accept_scene=self.accept_scene)


#: The run's own device, all threads, and an unchanged scene.
AS_IT_IS = How()

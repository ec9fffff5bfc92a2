"""One run of a sweep, its id, and the layout of the sweep's folder."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any, Final

#: Settings that change neither the training nor the results.
_OF_NO_CONSEQUENCE: Final = (
    *("scene", "out", "threads", "stop_after", "save_every", "decided"),
    *("revisions", "planned_seconds", "planned_views"),
)
_DIGITS: Final = 12


@dataclass(frozen=True)
class Job:
    """A run.

    Attributes:
        id: The id, which is the name of the run's folder.
        label: Name of the run's configuration.
        scene: Name of the run's scene.
        seed: The seed of the run.
        settings: The settings with which the run is started.
        seconds: Limit of training seconds; None if another setting limits the length of the run.
    """

    id: str
    label: str
    scene: str
    seed: int
    settings: Mapping[str, Any]
    seconds: float | None = None

    @property
    def title(self) -> str:
        """Description of the run in one line."""
        return f"{self.scene}, {self.label}, seed {self.seed}"


def run_id(resolved: Mapping[str, Any], fingerprint: str) -> str:
    """Return the id of a run: a hash of its resolved configuration, with seed, and its scene.

    Args:
        resolved: The configuration with all options of all components.
        fingerprint: Digest of the scene, independent of its folder.
    """
    kept = {name: value for name, value in resolved.items() if name not in _OF_NO_CONSEQUENCE}
    if kept.get("seconds") is not None:
        # Leave out the number of steps, because the time limit determines it.
        kept.pop("steps", None)
    text = json.dumps([kept, fingerprint], sort_keys=True, default=str)
    return sha256(text.encode()).hexdigest()[:_DIGITS]


@dataclass(frozen=True)
class Layout:
    """The folder of a sweep.

    Attributes:
        out: The folder.
    """

    out: Path

    def run(self, name: str) -> Path:
        """Return the results folder of a run of `crossgrad run`."""
        return self.out / "runs" / name

    def settings(self, name: str) -> Path:
        """Return the settings file of a run."""
        return self.out / "settings" / f"{name}.yaml"

    def output(self, name: str) -> Path:
        """Return the file with the output of a run's processes."""
        return self.out / "output" / f"{name}.txt"

    @property
    def records(self) -> Path:
        """The folder of the workers' records, one file for each worker."""
        return self.out / "workers"

    @property
    def plan(self) -> Path:
        """The table of all runs."""
        return self.out / "runs.csv"

    def make(self) -> None:
        """Make the folders."""
        for path in ("runs", "settings", "output", "workers"):
            (self.out / path).mkdir(parents=True, exist_ok=True)

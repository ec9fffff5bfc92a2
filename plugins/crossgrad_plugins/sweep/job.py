"""A run of a sweep, its id, and the paths in the folder of the sweep."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any, Final

#: Settings that affect neither the training nor the results.
_OF_NO_CONSEQUENCE: Final = (
    *("scene", "out", "threads", "stop_after", "save_every", "decided"),
    *("revisions", "planned_seconds", "planned_views"),
)
_DIGITS: Final = 12


@dataclass(frozen=True)
class Job:
    """A run of a sweep.

    Attributes:
        id: The id of the run, which is also the name of its folder.
        label: Name of the run's configuration.
        scene: Name of the run's scene.
        seed: The seed of the run.
        settings: The settings with which the run is started.
        seconds: Limit of the training time in seconds; None if another setting limits the run.
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
    """Return the id of a run: a hash of its scene and its resolved configuration with seed.

    Args:
        resolved: The configuration, with all options of all components.
        fingerprint: Digest of the scene's content, which does not depend on its folder.
    """
    kept = {name: value for name, value in resolved.items() if name not in _OF_NO_CONSEQUENCE}
    if kept.get("seconds") is not None:
        # Leave out the number of steps, because the time limit determines it.
        kept.pop("steps", None)
    text = json.dumps([kept, fingerprint], sort_keys=True, default=str)
    return sha256(text.encode()).hexdigest()[:_DIGITS]


@dataclass(frozen=True)
class Layout:
    """The paths in the folder of a sweep.

    Attributes:
        out: The folder of the sweep.
    """

    out: Path

    def run(self, name: str) -> Path:
        """Return the folder in which `crossgrad run` writes the results of a run."""
        return self.out / "runs" / name

    def settings(self, name: str) -> Path:
        """Return the settings file of a run."""
        return self.out / "settings" / f"{name}.yaml"

    def output(self, name: str) -> Path:
        """Return the file for the output of a run's processes."""
        return self.out / "output" / f"{name}.txt"

    @property
    def records(self) -> Path:
        """The folder of the records, with one file for each worker."""
        return self.out / "workers"

    @property
    def plan(self) -> Path:
        """The table of all runs."""
        return self.out / "runs.csv"

    def make(self) -> None:
        """Create the folders."""
        for path in ("runs", "settings", "output", "workers"):
            (self.out / path).mkdir(parents=True, exist_ok=True)

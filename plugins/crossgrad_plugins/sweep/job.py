"""One run of a sweep, its id, and where things are in the folder of the sweep."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any, Final

#: Settings that change neither what is trained nor what is reported.
_OF_NO_CONSEQUENCE: Final = (
    *("scene", "out", "threads", "stop_after", "save_every", "decided"),
    *("revisions", "planned_seconds", "planned_views"),
)
_DIGITS: Final = 12


@dataclass(frozen=True)
class Job:
    """A run.

    Attributes:
        id: Its id, which names its folder.
        label: What its configuration is called.
        scene: Name of its scene.
        seed: Its seed.
        settings: What it is started with.
        seconds: Its budget of training seconds; None where its length is another.
    """

    id: str
    label: str
    scene: str
    seed: int
    settings: Mapping[str, Any]
    seconds: float | None = None

    @property
    def title(self) -> str:
        """What it is called in one line."""
        return f"{self.scene}, {self.label}, seed {self.seed}"


def run_id(resolved: Mapping[str, Any], fingerprint: str) -> str:
    """The id of a run: a hash of its resolved configuration, seed included, and its scene.

    Args:
        resolved: The configuration with all options of all components.
        fingerprint: Digest of the scene, wherever that lies.
    """
    kept = {name: value for name, value in resolved.items() if name not in _OF_NO_CONSEQUENCE}
    if kept.get("seconds") is not None:
        kept.pop("steps", None)  # They follow the clock.
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

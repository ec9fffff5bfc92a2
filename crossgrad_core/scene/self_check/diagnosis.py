"""The cause of a disagreement, found by trial."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from crossgrad_core.scene.self_check.evidence import FEWEST, Agreement, Evidence
from crossgrad_core.scene.self_check.rig import Floats, Integers, Rig
from crossgrad_core.scene.self_check.trials import (
    Search,
    Trial,
    likely,
    other_axes,
    probes,
    searches,
)

#: Cameras that trials are made with.
MOST_CAMERAS: Final = 12
#: Points in frame below which an untracked camera counts as seeing nothing.
_FEWEST_UNTRACKED: Final = 3 * FEWEST
#: A later trial must be so much better than an earlier, simpler one.
_CLEARLY: Final = 0.03
#: A probe must be so much better than the scene as it is.
_PROBED: Final = 0.01
#: How often the step of a search is halved.
_ROUNDS: Final = 4
#: How well the photos of a scene agree at least, and what a change that repairs a scene gains.
LEAST: Final = 0.35
GAINED: Final = 0.25


@dataclass(frozen=True)
class Diagnosis:
    """The trial that fits best.

    Attributes:
        before: How well the photos agree as they are, in [0, 1].
        after: How well they agree after the change.
        trial: The change; None if none is better.
    """

    before: float
    after: float
    trial: Trial | None

    @property
    def repairs(self) -> bool:
        """Whether the change makes photos agree that did not."""
        return self.after >= LEAST and self.after >= self.before + GAINED


def scores(agreement: Agreement, *, tracked: bool) -> Floats:
    """[V] how well photos agree, in [0, 1]: correlation, times the share in frame of tracks."""
    correlation = np.maximum(np.nan_to_num(agreement.correlation), 0.0)
    if tracked:
        return np.asarray(correlation * np.nan_to_num(agreement.share))
    return np.where(agreement.inside >= _FEWEST_UNTRACKED, correlation, 0.0)


def some(cameras: Integers, most: int = MOST_CAMERAS) -> Integers:
    """At most so many cameras, evenly spread."""
    every = np.linspace(0, len(cameras) - 1, min(len(cameras), most))
    return cameras[every.round().astype(np.int64)]


class Bench:
    """Tries changes on some cameras of the evidence."""

    def __init__(self, evidence: Evidence, cameras: Integers) -> None:
        self._evidence = evidence.chosen(some(cameras))
        self.before = self.score(self._evidence.rig)

    def score(self, rig: Rig) -> float:
        """How well the photos agree in a rig, mean over the cameras."""
        return float(scores(self._evidence.agreement(rig), tracked=self._evidence.tracked).mean())

    def tried(self, trial: Trial) -> float:
        """How well the photos agree after a change."""
        with np.errstate(all="ignore"):
            return self.score(trial.change(self._evidence.rig))

    def is_off(self) -> bool:
        """Whether a small change makes the photos agree better."""
        evidence = self._evidence
        first, *others = [probe.change(evidence.rig) for probe in probes()]
        rows = np.tile(evidence.rows, (1 + len(others), 1))
        agreement = replace(evidence, rows=rows).agreement(first.joined(others))
        each = scores(agreement, tracked=evidence.tracked).reshape(1 + len(others), -1).mean(axis=1)
        return bool(each.max() > self.before + _PROBED)

    def diagnosis(self) -> Diagnosis:
        """The change that makes the photos agree best; the likely ones are tried first."""
        found = self.best(likely())
        if not found.repairs:
            for search in searches():
                found = _better(found, *self._searched(search))
        return found if found.repairs else self.best(other_axes(), found)

    def best(self, trials: Iterable[Trial], found: Diagnosis | None = None) -> Diagnosis:
        """The best of some trials, if it is better than what was found before."""
        found = found or Diagnosis(self.before, self.before, None)
        for trial in trials:
            found = _better(found, self.tried(trial), trial)
        return found

    def _searched(self, search: Search) -> tuple[float, Trial]:
        """The best numbers of a search: the best of those given, then between their neighbours."""
        tried = [self.tried(search.trial(value)) for value in search.values]
        best, score, step = search.values[int(np.argmax(tried))], max(tried), search.step
        for _ in range(_ROUNDS):
            step /= 2.0
            around = best + step * np.vstack([np.eye(len(best)), -np.eye(len(best))])
            tried = [self.tried(search.trial(value)) for value in around]
            if max(tried) > score:
                best, score = around[int(np.argmax(tried))], max(tried)
        return score, search.trial(best)


def _better(found: Diagnosis, score: float, trial: Trial) -> Diagnosis:
    return Diagnosis(found.before, score, trial) if score > found.after + _CLEARLY else found

"""Seconds by what they were spent on, and what a training step spends them on."""

from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Final, Literal

Phase = Literal[
    "photos",
    "decode",
    "render",
    "loss",
    "backward",
    "aggregation",
    "optimizer",
    "density_control",
    "other",
]
#: What a step spends time on: `photos` is choosing views and scales and having the photos at hand
#: (decoding files is loading), `loss` has exposure, pixel weights and regularisation in it.
PHASES: Final[tuple[Phase, ...]] = (
    "photos",
    "decode",
    "render",
    "loss",
    "backward",
    "aggregation",
    "optimizer",
    "density_control",
    "other",
)


@dataclass
class Clock:
    """Seconds by what they were spent on; only `train` counts as training.

    Attributes:
        train: Training.
        compile: Compiling kernels.
        load: Reading the scene and decoding photos.
        evaluate: Evaluating held-out views.
        report: Writing results.
        phases: Training seconds by phase of the step; together they are `train`. On a GPU work is
            counted in the phase that waits for it.
    """

    train: float = 0.0
    compile: float = 0.0
    load: float = 0.0
    evaluate: float = 0.0
    report: float = 0.0
    phases: dict[str, float] = field(default_factory=dict)

    def copy(self) -> "Clock":
        """A copy that stays as it is."""
        return replace(self, phases=dict(self.phases))

    def count(self, laps: "Laps") -> None:
        """Adds a complete step."""
        self.train += laps.total
        for phase in PHASES:
            self.phases[phase] = self.phases.get(phase, 0.0) + laps.spent.get(phase, 0.0)


@dataclass
class Laps:
    """The phases of the step under way; a step that is cut short counts for none.

    Attributes:
        border: When the present phase began.
        total: Seconds from the start of the step to the last border, without what was left out.
        spent: Phase -> seconds.
    """

    border: float = field(default_factory=perf_counter)
    total: float = 0.0
    spent: dict[str, float] = field(default_factory=dict)

    def lap(self, phase: Phase) -> None:
        """Ends a phase here: the seconds since the last border were spent on it."""
        now = perf_counter()
        seconds = now - self.border
        self.spent[phase] = self.spent.get(phase, 0.0) + seconds
        self.total += seconds
        self.border = now

    def leave_out(self, seconds: float) -> None:
        """Does not count seconds of the present phase: they belong to another clock."""
        self.border += seconds

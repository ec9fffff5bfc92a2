"""Seconds by what they were spent on, and what a training step spends them on."""

from dataclasses import dataclass, field, replace
from time import perf_counter, process_time
from typing import Final, Literal, get_args

#: What a budget counts: seconds of the clock on the wall, or of CPU time of the process.
ClockKind = Literal["wall", "cpu"]
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
PHASES: Final[tuple[Phase, ...]] = get_args(Phase)


@dataclass
class Clock:
    """Seconds by what they were spent on; only `train` counts as training.

    Attributes:
        train: Training.
        compile: Compiling kernels.
        load: Reading the scene and decoding photos.
        evaluate: Evaluating held-out views.
        report: Writing results.
        phases: Training seconds by phase of the step; together they are `train`. Work of a GPU, or
            of the other threads alone, is counted in the phase that waits for it.
        cpu: Seconds of CPU time that the process took while it trained, all threads together, but
            for what others do between two steps where this clock is no budget.
    """

    train: float = 0.0
    compile: float = 0.0
    load: float = 0.0
    evaluate: float = 0.0
    report: float = 0.0
    phases: dict[str, float] = field(default_factory=dict)
    cpu: float = 0.0

    def trained(self, kind: ClockKind) -> float:
        """Training seconds of that kind."""
        return self.cpu if kind == "cpu" else self.train

    def copy(self) -> "Clock":
        """A copy that stays as it is."""
        return replace(self, phases=dict(self.phases))

    def count(self, laps: "PhaseTimer") -> None:
        """Adds a complete step."""
        self.train += laps.total
        self.cpu += laps.cpu
        for phase in PHASES:
            self.phases[phase] = self.phases.get(phase, 0.0) + laps.spent.get(phase, 0.0)


@dataclass
class PhaseTimer:
    """The phases of the step under way; a step that is cut short counts for none.

    Attributes:
        border: When the present phase began.
        total: Seconds from the start of the step to the last border, without what was left out.
        spent: Phase -> seconds.
        cpu: CPU seconds of the process from the start of the step to the last border, likewise.
        cpu_border: CPU time of the process at the last border.
    """

    phase_began: float = field(default_factory=perf_counter)
    total: float = 0.0
    spent: dict[str, float] = field(default_factory=dict)
    cpu: float = 0.0
    cpu_border: float = field(default_factory=process_time)

    def lap(self, phase: Phase) -> None:
        """Ends a phase here: the seconds since the last border were spent on it."""
        now = perf_counter()
        seconds = now - self.phase_began
        self.spent[phase] = self.spent.get(phase, 0.0) + seconds
        self.total += seconds
        self.phase_began = now
        cpu = process_time()
        self.cpu += cpu - self.cpu_border
        self.cpu_border = cpu

    def leave_out(self, seconds: float, cpu: float) -> None:
        """Does not count seconds of the present phase: they belong to another clock.

        Args:
            seconds: Seconds on the wall.
            cpu: Seconds of CPU time in them.
        """
        self.phase_began += seconds
        self.cpu_border += cpu

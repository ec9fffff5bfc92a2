"""When things happen, in optimizer steps (1-based: the first step is step 1)."""

from dataclasses import dataclass, replace
from typing import Literal

ScheduleMode = Literal["scaled", "absolute"]

#: The length that every published figure is written for (3DGS).
REFERENCE_STEPS = 30_000
#: Learning rates of colour, scale and opacity are not stretched with the run, so the first
#: transient always takes some hundred steps. Gradients are large everywhere during it, and growing
#: then copies Gaussians that only had to settle.
SHORTEST_WARM_UP = 500
#: The statistics of so many steps decide about growth, at least (the published interval).
SHORTEST_INTERVAL = 100
#: The same for anchors, which count by offset and keep what was too rarely seen to be judged. Half
#: the published interval: growth of anchors is what short runs lack (docs/benchmarks.md).
SHORTEST_ANCHOR_INTERVAL = 50
#: Shorter runs have no opacity reset: they could not recover from one.
SHORTEST_RUN_WITH_RESET = 10_000


@dataclass(frozen=True)
class Schedule:
    """All schedule lengths of one run, in optimizer steps.

    Attributes:
        mode: Whether the published schedule was stretched with the run.
        total: Length of the run.
        lr_steps: Length of the log-linear learning-rate decay.
        sh_interval: The SH degree grows by one every so many steps.
        densify_from: Density control edits after this step ...
        densify_until: ... and before this one.
        densify_every: Interval of edits.
        reset_every: Interval of opacity resets; None where there are none.
        anchors_from: Anchor growing starts after this step.
        anchors_every: Interval of anchor growing.
        coarse_until: Backbones that train from coarse to fine have all levels from this step on.
        sh_from: SH degree at the first step.
    """

    mode: ScheduleMode
    total: int
    lr_steps: int
    sh_interval: int
    densify_from: int
    densify_until: int
    densify_every: int
    reset_every: int | None
    anchors_from: int
    anchors_every: int
    coarse_until: int
    sh_from: int = 0

    @classmethod
    def for_run(cls, total: int, mode: ScheduleMode = "scaled") -> "Schedule":
        """The schedule of a run of `total` steps.

        `scaled` stretches the published 30,000-step schedule with floors; `absolute` keeps the
        published numbers whatever the length.
        """
        if mode == "absolute":
            coarse = min(REFERENCE_STEPS // 4, total // 2)
            return cls(
                mode, total, REFERENCE_STEPS, 1000, 500, 15_000, 100, 3000, 1500, 100, coarse
            )
        return cls(
            mode=mode,
            total=total,
            lr_steps=total,
            sh_interval=max(100, total // 30),
            densify_from=max(total // 60, SHORTEST_WARM_UP),
            densify_until=total // 2,
            densify_every=max(SHORTEST_INTERVAL, total // 300),
            reset_every=total // 10 if total >= SHORTEST_RUN_WITH_RESET else None,
            anchors_from=total // 20,
            anchors_every=max(SHORTEST_ANCHOR_INTERVAL, total // 300),
            coarse_until=total // 4,
        )

    def edits(self, after: int = 0) -> int:
        """Number of steps behind `after` that density control follows with an edit."""
        passed = max(after, self.densify_from) // self.densify_every
        return max(0, (self.densify_until - 1) // self.densify_every - passed)

    @property
    def grows(self) -> bool:
        """Whether density control edits at all."""
        return self.edits() > 0

    @property
    def first_edit(self) -> int:
        """The first step after which density control edits, where it edits at all."""
        return (self.densify_from // self.densify_every + 1) * self.densify_every

    def lengthened(self, wanted: "Schedule", step: int) -> "Schedule":
        """This schedule with the length of another one, from the end of a step on.

        The ends of the run, of the learning-rate decay and of density control move as far as they
        are still ahead. Intervals stay, so that nothing happens twice or is left out; density
        control that is over does not come back, and no level closes that was open.

        Args:
            wanted: The schedule of a run that was as long from its start.
            step: The step that the run has reached.
        """
        over = step >= self.densify_until
        return replace(
            self,
            total=wanted.total,
            lr_steps=wanted.lr_steps,
            densify_until=self.densify_until if over else max(step, wanted.densify_until),
            coarse_until=min(self.coarse_until, wanted.coarse_until),
        )

    def sh_degree(self, step: int, maximum: int = 3) -> int:
        """Active spherical-harmonics degree at a step."""
        return min(maximum, self.sh_from + step // self.sh_interval)

    def densifies(self, step: int) -> bool:
        """Whether density control edits the primitives after this step."""
        inside = self.densify_from < step < self.densify_until
        return inside and step % self.densify_every == 0

    def collects(self, step: int) -> bool:
        """Whether densification statistics of this step are still needed."""
        return step < self.densify_until

    def prunes_large(self, step: int) -> bool:
        """Whether an edit after this step removes what is large in the world.

        After the first opacity reset, as published, and never where there is none.
        """
        return self.reset_every is not None and step > self.reset_every

    def resets(self, step: int) -> bool:
        """Whether opacities are reset after this step."""
        every = self.reset_every
        return every is not None and step < self.densify_until and step % every == 0


@dataclass(frozen=True)
class Phase:
    """The moment in which a backbone decodes: step, schedule, training or evaluation."""

    step: int
    training: bool
    schedule: Schedule

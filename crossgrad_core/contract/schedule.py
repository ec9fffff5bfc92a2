"""The schedule of a run, counted in rendered views or in steps."""

from bisect import bisect_left
from dataclasses import dataclass, replace
from itertools import pairwise
from math import log
from typing import Final, Literal

from typing_extensions import override

_FORM: Final = "must be a number of at least 1, or A..B@SHARE[..C@SHARE], such as 1..2@0.5"


@dataclass(frozen=True)
class ViewsPerStep:
    """The number of views K of each step in a run of known length.

    Attributes:
        starts: Number of steps after which each K begins; ascending, the first is 0.
        counts: The values of K.
    """

    starts: tuple[int, ...] = (0,)
    counts: tuple[int, ...] = (1,)

    def at(self, step: int) -> int:
        """Return K of a step (1-based)."""
        return self.counts[max(0, bisect_left(self.starts, step) - 1)]

    def views(self, step: int) -> int:
        """Return the number of views drawn in all steps up to and including `step`."""
        ends = (*self.starts[1:], step)
        parts = zip(self.starts, ends, self.counts, strict=True)
        return sum(max(0, min(end, step) - start) * count for start, end, count in parts)

    def step_of(self, views: int) -> int:
        """Return the step that draws the view with this number (1-based); 0 for view 0."""
        start, count = self.starts[0], self.counts[0]
        for later, then in zip(self.starts[1:], self.counts[1:], strict=True):
            if self.views(later) >= views:
                break
            start, count = later, then
        return start + max(0, -((self.views(start) - views) // count))

    def moved(self, wanted: "ViewsPerStep", step: int) -> "ViewsPerStep":
        """Return the values of K after a change of the run's length; past changes of K do not move.

        Args:
            wanted: Values of K of a run that had the new length from its start.
            step: Number of completed steps.
        """
        pairs = zip(self.starts, wanted.starts, strict=True)
        starts = (old if old < step else max(step, new) for old, new in pairs)
        return ViewsPerStep(tuple(starts), self.counts)


#: One view in every step.
ONE_BY_ONE: Final = ViewsPerStep()


@dataclass(frozen=True)
class ViewsPerStepSpec:
    """K of a run of any length: one number, or several numbers that begin at shares of the run.

    Attributes:
        counts: The values of K.
        shares: The share of the run's steps after which each K begins; the first K has no share.
    """

    counts: tuple[int, ...] = (1,)
    shares: tuple[float, ...] = ()

    @classmethod
    def parsed(cls, text: str) -> "ViewsPerStepSpec":
        """Return the specification in a text such as `2` or `1..2@0.5`.

        Raises:
            ValueError: The text does not describe a specification.
        """
        first, *others = text.split("..")
        try:
            parts = [part.split("@") for part in others]
            counts = (int(first), *(int(count) for count, _ in parts))
            shares = tuple(float(share) for _, share in parts)
        except ValueError as error:
            raise ValueError(_FORM) from error
        inside = (0.0, *shares, 1.0)
        if not all(a < b for a, b in pairwise(inside)):
            raise ValueError("must list shares in ascending order, each above 0 and below 1")
        if min(counts) < 1:
            raise ValueError(_FORM)
        if any(a == b for a, b in pairwise(counts)):
            raise ValueError("must have two different numbers")
        return cls(counts, shares)

    @override
    def __str__(self) -> str:
        pairs = zip(self.counts[1:], self.shares, strict=True)
        later = (f"{count}@{share:g}" for count, share in pairs)
        return "..".join((str(self.counts[0]), *later))

    @property
    def setting(self) -> int | str:
        """The specification as a setting: a plain number if K does not change."""
        return str(self) if self.shares else self.counts[0]

    def paced(self, total: int) -> ViewsPerStep:
        """Return K of every step of a run of `total` steps."""
        return ViewsPerStep((0, *(round(share * total) for share in self.shares)), self.counts)

    def steps_of(self, views: int) -> int:
        """Return the largest number of steps in which a run draws at most `views` views."""
        fits, too_many = 0, views // min(self.counts) + 1
        while too_many - fits > 1:
            steps = (fits + too_many) // 2
            if self.paced(steps).views(steps) <= views:
                fits = steps
            else:
                too_many = steps
        return fits


#: One view per step, as published.
ONE_VIEW: Final = ViewsPerStepSpec()
ScheduleMode = Literal["scaled", "absolute"]
Unit = Literal["views", "steps"]
#: Number of steps of a run of 3DGS, with one view per step. All published numbers refer to this
#: length.
REFERENCE = 30_000
#: Length in views up to which the settings for short runs have their full effect.
SHORT = 3_000
#: Shortest warm-up without growth. In the first few hundred steps of a run of any length, gradients
#: are large everywhere. Growth in these steps would copy Gaussians that only need to converge.
SHORTEST_WARM_UP = 500
#: Shortest interval over which growth statistics are collected (the published interval).
SHORTEST_INTERVAL = 100
#: Shortest interval of anchor growing. The number is half the published interval, because short
#: runs grow too few anchors with the published interval (docs/benchmarks.md).
SHORTEST_ANCHOR_INTERVAL = 50
#: Runs with a length below this number make no opacity reset, because these runs are too short to
#: recover from a reset.
SHORTEST_RUN_WITH_RESET = 10_000
#: If edits are counted in views, an interval is one pass over the training photos. The interval is
#: shorter if the run would otherwise make fewer edits than this number.
USUAL_EDITS = 6
#: Shortest interval of edits in a run with a minimum number of edits. With statistics of fewer
#: views, nearly every Gaussian would be cloned or split.
LEAST_INTERVAL = 8


def is_published(mode: ScheduleMode, reference: int | None) -> bool:
    """Return True if a schedule uses the published numbers in a run of any length."""
    return mode == "absolute" and reference is None


@dataclass(frozen=True)
class Counting:
    """The unit in which a schedule counts, and properties of the run that affect the schedule.

    Attributes:
        unit: The unit of the schedule's numbers, views or steps.
        views: Number of views per step.
        photos: Number of training photos. An edit uses the statistics of at least this many views
            if the run is long enough.
        schedule_length: Length for which the schedule is written. If None, a scaled schedule uses
            the length of the run, and an absolute schedule uses the published length.
        min_refinements: Minimum number of density control edits in a run of any length. In a short
            run, warm-up and interval are shortened to reach this number. This field is used only if
            the schedule counts views.
    """

    unit: Unit = "steps"
    views: ViewsPerStepSpec = ONE_VIEW
    photos: int = 1
    schedule_length: int | None = None
    min_refinements: int = 0


IN_STEPS = Counting()


@dataclass(frozen=True)
class Schedule:
    """The schedule of one run, counted in views or in steps; `total` is always in steps.

    Attributes:
        mode: `scaled` if the published schedule was stretched with the run, else `absolute`.
        total: Length of the run, in steps.
        length: The length for which the schedule is written; the run's own length if the schedule
            was stretched.
        lr_until: Count at which the log-linear learning-rate decay ends.
        sh_interval: The SH degree grows by one at every multiple of this count.
        densify_from: Density control makes edits after this count. If views are counted, the edits
            are at this count plus multiples of the interval; if steps are counted, at multiples of
            the interval.
        densify_until: Density control makes edits before this count only.
        densify_every: Interval of edits.
        reset_every: Interval of opacity resets; None if there are no resets.
        anchors_from: Anchor growing starts after this count.
        anchors_every: Interval of anchor growing.
        coarse_until: From this count on, backbones that train from coarse to fine use all levels.
        sh_from: SH degree at the first step.
        sh_wait: The SH degree does not grow before this count.
        counting: The unit of the counts.
        pace: Number of views K of every step.
        edits_before: Number of edits before `densify_from` in a run whose length a time budget
            changed.
        min_refinements: Minimum number of edits of the run, also after a change of its length, if
            the run is long enough.
    """

    mode: ScheduleMode
    total: int
    length: int
    lr_until: int
    sh_interval: int
    densify_from: int
    densify_until: int
    densify_every: int
    reset_every: int | None
    anchors_from: int
    anchors_every: int
    coarse_until: int
    sh_from: int = 0
    sh_wait: int = 0
    counting: Counting = IN_STEPS
    pace: ViewsPerStep = ONE_BY_ONE
    edits_before: int = 0
    min_refinements: int = 0

    @classmethod
    def for_run(
        cls, total: int, mode: ScheduleMode = "scaled", counting: Counting = IN_STEPS
    ) -> "Schedule":
        """Return the schedule of a run of `total` steps.

        Mode `scaled` stretches the published schedule to the length of the run, with lower bounds
        on intervals. Mode `absolute` uses the numbers of the published length, or of
        `counting.schedule_length`.
        """
        pace = counting.views.paced(total)
        run_length = pace.views(total) if counting.unit == "views" else total
        length = run_length if mode == "scaled" else counting.schedule_length or REFERENCE
        schedule = cls(
            mode=mode,
            total=total,
            length=length,
            lr_until=length,
            sh_interval=max(100, length // 30),
            densify_from=0,  # `with_edits` sets the times of edits later.
            densify_until=0,
            densify_every=1,
            reset_every=length // 10 if length >= SHORTEST_RUN_WITH_RESET else None,
            anchors_from=length // 20,
            anchors_every=max(SHORTEST_ANCHOR_INTERVAL, length // 300),
            coarse_until=min(length // 4, run_length // 2),
            counting=counting,
            pace=pace,
        )
        if counting.unit == "views" and not schedule.published:
            schedule = replace(schedule, min_refinements=counting.min_refinements)
        return schedule.with_edits(until=length // 2)

    def with_edits(
        self, *, until: int, start: int | None = None, every: int | None = None
    ) -> "Schedule":
        """Return the schedule with another window of density control.

        If the schedule counts views, the interval and the start are fitted to the window. An
        interval is at least one pass over the training photos if the window then still contains
        `USUAL_EDITS` edits. The start and the interval are shortened if the window would contain
        fewer than `min_refinements` edits.

        Args:
            until: Edits end before this count.
            start: Edits begin after this count; by default as in 3DGS.
            every: Interval of edits; by default as in 3DGS.
        """
        start = max(self.length // 60, SHORTEST_WARM_UP) if start is None else start
        every = max(SHORTEST_INTERVAL, self.length // 300) if every is None else every
        last, photos = until - 1, self.counting.photos
        if self.counting.unit == "views" and not self.published:
            every = max(every, min(photos, (last - start) // USUAL_EDITS))
        if self.min_refinements:
            # Use an interval of at least one pass over the photos if enough edits then still fit.
            whole = max(every, photos) if photos <= last // self.min_refinements else every
            start, every = _fitted(start, last, whole, photos, self.min_refinements)
        return replace(self, densify_from=start, densify_until=until, densify_every=every)

    @property
    def published(self) -> bool:
        """True if the schedule is published; see `is_published`."""
        return is_published(self.mode, self.counting.schedule_length)

    def counted(self, step: int) -> int:
        """Return the count after a step: the number of drawn views, or the number of steps."""
        return self.pace.views(step) if self.counting.unit == "views" else step

    def step_of(self, count: int) -> int:
        """Return the first step after which the count is at least `count`."""
        return self.pace.step_of(count) if self.counting.unit == "views" else count

    def reaches(self, step: int, every: int) -> bool:
        """Return True if the count reaches a multiple of `every` in this step."""
        return self.counted(step) // every > self.counted(step - 1) // every

    def progress(self, step: int) -> float:
        """Return the completed share of the learning-rate decay after a step; may exceed 1."""
        return self.counted(step) / self.lr_until

    def edits(self, after: int = 0) -> int:
        """Return the number of steps after step `after` in which density control makes an edit."""
        ahead = self._edits_ahead(after)
        if self.counting.unit == "steps" or self.densify_every >= max(self.pace.counts):
            return len(ahead)
        return len(self.edit_steps(after))

    def edit_steps(self, after: int = 0) -> list[int]:
        """Return the steps after step `after` in which density control makes an edit, in order."""
        return sorted({self.step_of(count) for count in self._edits_ahead(after)})

    def _edits_ahead(self, after: int) -> range:
        """Return the counts of all planned edits after a step."""
        end = min(self.densify_until, self.counted(self.total) + 1)
        return range(self.next_edit(self.counted(after)), end, self.densify_every)

    @property
    def grows(self) -> bool:
        """True if density control makes at least one edit in this run.

        Edits before a change of the run's length count, too.
        """
        return self.edits_before + self.edits() > 0

    @property
    def first_edit(self) -> int:
        """The step of the first density control edit; it may be after the end of the run."""
        return self.step_of(self.next_edit(0))

    def next_edit(self, count: int) -> int:
        """Return the count of the first edit after `count`, even after the last planned edit."""
        # If steps are counted, edits are at multiples of the interval, as published.
        every, origin = self.densify_every, 0
        if self.counting.unit == "views":
            origin = self.densify_from
        behind = max(count, self.densify_from)
        return origin + ((behind - origin) // every + 1) * every

    def with_length(self, wanted: "Schedule", step: int) -> "Schedule":
        """Return this schedule with the length of another schedule for all steps after `step`.

        The ends of the run, of the learning-rate decay and of density control move if they are
        after `step`. Changes of K after `step` move, too. Intervals do not change; otherwise an
        event could occur twice or be omitted. Density control does not restart after its end.
        Levels and spherical harmonics that are already in use stay in use. If a minimum number of
        edits is set, the remaining edits are planned again. If no edit was made yet, the start of
        the edits moves, too. The interval shrinks if there would be too few edits.

        Args:
            wanted: The schedule of a run that had the new length from its start.
            step: The step that the run has reached.
        """
        count = self.counted(step)
        over = count >= self.densify_until
        longer = replace(
            self,
            total=wanted.total,
            length=wanted.length,
            lr_until=wanted.lr_until,
            pace=self.pace.moved(wanted.pace, step),
            coarse_until=min(self.coarse_until, wanted.coarse_until),
            sh_wait=self.sh_wait if count >= self.sh_wait else max(count, wanted.sh_wait),
        )
        if over:
            return longer
        longer = replace(longer, min_refinements=wanted.min_refinements)
        if longer.min_refinements:
            return _with_edits_ahead(longer, wanted, step)
        return replace(longer, densify_until=max(count, wanted.densify_until))

    def sh_degree(self, step: int, maximum: int = 3) -> int:
        """Return the active spherical-harmonics degree at a step."""
        count = self.counted(step)
        more = count // self.sh_interval if count >= self.sh_wait else 0
        return min(maximum, self.sh_from + more)

    def densifies(self, step: int) -> bool:
        """Return True if density control makes an edit after this step."""
        edit = self.next_edit(self.counted(step - 1))
        return edit <= self.counted(step) and edit < self.densify_until

    def collects(self, step: int) -> bool:
        """Return True if a later edit uses the densification statistics of this step."""
        return self.counted(step - 1) + 1 < self.densify_until

    def prunes_large(self, step: int) -> bool:
        """Return True if an edit after this step removes primitives that are large in world space.

        As published, edits remove large primitives after the first opacity reset, and never in runs
        without resets.
        """
        return self.reset_every is not None and self.counted(step - 1) >= self.reset_every

    def resets(self, step: int) -> bool:
        """Return True if opacities are reset after this step."""
        every = self.reset_every
        if every is None or not self.reaches(step, every):
            return False
        return self.counted(step) // every * every < self.densify_until


def _with_edits_ahead(schedule: Schedule, wanted: Schedule, step: int) -> Schedule:
    """Return the schedule with all edits after `step` planned as in `wanted`."""
    now = schedule.counted(step)
    done = schedule.edits_before + schedule.edits() - schedule.edits(step)
    missing = max(0, schedule.min_refinements - done)
    every, until = wanted.densify_every, max(now, wanted.densify_until)
    if done:
        start = schedule.next_edit(now) - schedule.densify_every
    else:
        start = wanted.densify_from if wanted.next_edit(0) > now else now
    needed = start + missing * every + 1
    if missing and needed > until:
        # Move the end of the edits later, so that a run that becomes far shorter than planned still
        # makes the missing edits.
        until = max(until, min(needed, (now + schedule.counted(schedule.total)) // 2))
        every = max(LEAST_INTERVAL, (until - 1 - start) // missing)
    return replace(
        schedule,
        densify_from=start,
        densify_until=until,
        densify_every=every,
        edits_before=done,
    )


def _fitted(start: int, last: int, every: int, photos: int, edits: int) -> tuple[int, int]:
    """Return a start and an interval that place `edits` edits no later than `last`, if possible.

    Args:
        start: Wanted start.
        last: Largest allowed count of the last edit.
        every: Wanted interval.
        photos: Number of training photos. The interval is at least this number if `edits` edits
            still fit.
        edits: Wanted number of edits.
    """
    wanted = start + edits * every
    if wanted > last:
        shrunk = every * max(0, last) // wanted
        every = photos if shrunk < photos <= last // edits else shrunk
        every = max(every, LEAST_INTERVAL)
        start = max(0, min(start, last - edits * every))
    return start, every


@dataclass(frozen=True)
class Phase:
    """The step, the schedule, and whether a backbone decodes for training or for evaluation."""

    step: int
    training: bool
    schedule: Schedule

    @property
    def count(self) -> int:
        """The schedule's count after the step."""
        return self.schedule.counted(self.step)


def shortness(views: float) -> float:
    """Return the shortness of a run: 1 up to `SHORT` views, 0 from the published length on.

    Between these two lengths, the shortness falls linearly with the logarithm of the length. The
    effect of settings for short runs decreases with the shortness.
    """
    short = log(REFERENCE / max(1.0, views)) / log(REFERENCE / SHORT)
    return min(1.0, max(0.0, short))

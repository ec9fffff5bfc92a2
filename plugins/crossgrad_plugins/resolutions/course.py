"""A scale that grows in steps over a part of a run, the window."""

from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import ceil

from crossgrad_core.plugin import Schedule

#: Where density control goes on for longer, the window ends at this share of the run.
LATEST = 0.9
#: Without density control it ends here.
USUAL = 0.5


@dataclass(frozen=True)
class Course:
    """Scales one after the other, then full size.

    Attributes:
        ends: Shares of the window, at most 1, up to which each scale lasts; none is below another
            one before it.
        scales: As many scales in (0, 1); likewise.
    """

    ends: tuple[float, ...] = ()
    scales: tuple[float, ...] = ()

    @classmethod
    def of_parts(cls, scales: Sequence[float]) -> "Course":
        """Scales that last equally long and fill the window together."""
        count = len(scales)
        return cls(tuple((part + 1) / count for part in range(count)), tuple(scales))

    @classmethod
    def of_stages(cls, stages: Iterable[tuple[float, float]]) -> "Course":
        """Scales with the share of the window at which each ends."""
        return cls(*map(tuple, zip(*stages, strict=True)))

    def at(self, progress: float) -> float:
        """The scale after that share of the window."""
        part = bisect_right(self.ends, progress)
        return self.scales[part] if part < len(self.scales) else 1.0

    def pixels(self, progress: float) -> float:
        """The sum of the pixels up to that share of the window, which may be over; 1 at full size.

        That is the integral of the squared scale.
        """
        borders = [min(end, progress) for end in (0.0, *self.ends)]
        parts = zip(pairwise(borders), self.scales, strict=True)
        reduced = sum((end - start) * scale**2 for (start, end), scale in parts)
        return reduced + progress - borders[-1]

    def text(self, schedule: Schedule, window: float) -> str:
        """The scales by step, of a run whose window is over at that count."""
        if not self.scales:
            return "full size"
        scales = (*self.scales, 1.0)
        starts = [schedule.step_of(ceil(end * window)) + 1 for end in (0.0, *self.ends)]
        told = [f"1/{1 / scales[0]:.3g} to step {starts[bisect_right(scales, scales[0])] - 1}"]
        for octave in (0.25, 0.5):
            part = bisect_left(scales, octave)
            if scales[0] < octave and scales[part] < 1.0:
                told.append(f"1/{1 / octave:g} from step {starts[part]}")
        return ", ".join((*told, f"full size from step {starts[-1]}"))


def window_of(schedule: Schedule, until: float | None) -> float:
    """The count, of views or of steps, from which on every view has its full size.

    Args:
        schedule: The schedule of the run.
        until: A share of the run; None for the end of density control, half of the run where there
            is none.
    """
    whole = schedule.counted(schedule.total)
    if until is not None:
        return until * whole
    return min(float(schedule.densify_until), LATEST * whole) if schedule.grows else USUAL * whole

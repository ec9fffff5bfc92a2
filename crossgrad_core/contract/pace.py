"""How many views each step of a run has, and how they add up."""

from bisect import bisect_left
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

from typing_extensions import override

_FORM: Final = "must be a number from 1 on, or A..B@SHARE[..C@SHARE], such as 1..2@0.5"


@dataclass(frozen=True)
class ViewsPerStep:
    """K of every step of a run of known length.

    Attributes:
        starts: After so many steps each K begins; ascending, the first is 0.
        counts: The Ks.
    """

    starts: tuple[int, ...] = (0,)
    counts: tuple[int, ...] = (1,)

    def at(self, step: int) -> int:
        """K of a step, 1-based."""
        return self.counts[max(0, bisect_left(self.starts, step) - 1)]

    def views(self, step: int) -> int:
        """Views drawn in all steps up to and including this one."""
        ends = (*self.starts[1:], step)
        parts = zip(self.starts, ends, self.counts, strict=True)
        return sum(max(0, min(end, step) - start) * count for start, end, count in parts)

    def step_of(self, views: int) -> int:
        """The step in which the view of that number, 1-based, is drawn; 0 for none."""
        start, count = self.starts[0], self.counts[0]
        for later, then in zip(self.starts[1:], self.counts[1:], strict=True):
            if self.views(later) >= views:
                break
            start, count = later, then
        return start + max(0, -((self.views(start) - views) // count))

    def moved(self, wanted: "ViewsPerStep", step: int) -> "ViewsPerStep":
        """This pace, changing when another one does, as far as that is still ahead.

        Args:
            wanted: The pace of a run of another length.
            step: The steps that are done.
        """
        pairs = zip(self.starts, wanted.starts, strict=True)
        starts = (old if old < step else max(step, new) for old, new in pairs)
        return ViewsPerStep(tuple(starts), self.counts)


#: The pace of one view in every step.
ONE_BY_ONE: Final = ViewsPerStep()


@dataclass(frozen=True)
class ViewsPerStepSpec:
    """K over a run of any length: one number, or several with the share at which each begins.

    Attributes:
        counts: The Ks.
        shares: The share of the run's steps after which each of them begins, the first left out.
    """

    counts: tuple[int, ...] = (1,)
    shares: tuple[float, ...] = ()

    @classmethod
    def parsed(cls, text: str) -> "ViewsPerStepSpec":
        """The plan that `2` or `1..2@0.5` stands for.

        Raises:
            ValueError: The text is none.
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
            raise ValueError("must have ascending shares above 0 and below 1")
        if min(counts) < 1:
            raise ValueError(_FORM)
        if any(a == b for a, b in pairwise(counts)):
            raise ValueError("must change from one number to another one")
        return cls(counts, shares)

    @override
    def __str__(self) -> str:
        pairs = zip(self.counts[1:], self.shares, strict=True)
        later = (f"{count}@{share:g}" for count, share in pairs)
        return "..".join((str(self.counts[0]), *later))

    @property
    def setting(self) -> int | str:
        """The plan as a setting: a plain number where K does not change."""
        return str(self) if self.shares else self.counts[0]

    def paced(self, total: int) -> ViewsPerStep:
        """The pace of a run of `total` steps."""
        return ViewsPerStep((0, *(round(share * total) for share in self.shares)), self.counts)

    def steps_of(self, views: int) -> int:
        """The most steps that draw no more than `views` views."""
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

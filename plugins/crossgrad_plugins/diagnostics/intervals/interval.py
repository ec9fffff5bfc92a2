"""A confidence interval."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Interval:
    """A confidence interval; infinite where there is no upper end.

    Both ends are NaN where it cannot be told, or where no value that there can be is credible.
    """

    low: float
    high: float

    def holds(self, value: float) -> bool:
        """Whether the value lies inside, ends included."""
        return self.low <= value <= self.high

    def times(self, factor: float) -> "Interval":
        """The interval of the quantity times a factor >= 0."""
        return Interval(self.low * factor, self.high * factor)


UNKNOWN = Interval(float("nan"), float("nan"))

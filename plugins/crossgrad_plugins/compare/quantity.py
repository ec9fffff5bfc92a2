"""The metric that is compared, its unit and margin, and the costs."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Final, NamedTuple

#: Numbers of seconds from this value on are shown without decimals.
_WHOLE: Final = 10.0


class _Kind(NamedTuple):
    """A kind of metric, recognised by the start of its name, with its default margin."""

    unit: str
    decimals: int
    margin: float


_KINDS: Final = {
    "psnr": _Kind("dB", 2, 0.1),
    "ssim": _Kind("", 4, 0.005),
    "lpips": _Kind("", 4, 0.005),
}
_OTHER: Final = _Kind("", 4, 0.005)


@dataclass(frozen=True)
class Quantity:
    """A metric of held-out views.

    Attributes:
        name: Name in the results, such as `psnr`.
        label: Name in texts and figures.
        unit: Unit of the metric; empty if it has no unit.
        decimals: Number of decimals shown.
        margin: Largest difference that counts as no difference in practice.
        falls: True if lower values are better.
    """

    name: str
    label: str
    unit: str
    decimals: int
    margin: float
    falls: bool = False

    @classmethod
    def of(cls, name: str, margin: float | None = None, *, falls: bool = False) -> "Quantity":
        """Return the metric with the given name.

        Without a given margin, it has its default margin.

        Args:
            name: Name of the metric.
            margin: Largest difference that counts as no difference in practice; None for the
                default.
            falls: True if lower values are better; always true for LPIPS.
        """
        start = next((start for start in _KINDS if name.startswith(start)), "")
        kind = _KINDS.get(start, _OTHER)
        label = " ".join([start.upper(), *name[len(start) :].strip("_").split("_")]).strip()
        wanted = kind.margin if margin is None else margin
        return cls(name, label, kind.unit, kind.decimals, wanted, falls=falls or start == "lpips")

    @property
    def with_unit(self) -> str:
        """The label with its unit, for an axis or a table."""
        return f"{self.label} ({self.unit})" if self.unit else self.label

    def better(self, first: float, second: float) -> bool:
        """Return True if the first value is better than the second."""
        return first < second if self.falls else first > second

    def shown(self, value: float) -> str:
        """Format a value without its unit."""
        return f"{value:.{self.decimals}f}"

    def difference(self, value: float) -> str:
        """Format a difference with its sign and unit."""
        return f"{value:+.{self.decimals}f} {self.unit}".rstrip()


class ClockChoice(StrEnum):
    """Which seconds are compared."""

    AUTO = "auto"
    WALL = "wall"
    CPU = "cpu"
    NONE = "none"


@dataclass(frozen=True)
class Cost:
    """A resource that runs spend.

    Attributes:
        name: Name in tables and file names.
        column: Its column in metrics.csv.
        axis: Label of the axis of a figure.
        unit: Unit, such as `s`.
        title: Name inside the phrase "at equal TITLE".
    """

    name: str
    column: str
    axis: str
    unit: str
    title: str

    def shown(self, amount: float) -> str:
        """Format an amount with its unit."""
        number = f"{amount:,.0f}" if amount >= _WHOLE or self.unit != "s" else f"{amount:.3g}"
        return f"{number} {self.unit}"


SECONDS: Final = Cost("seconds", "train_seconds", "training seconds", "s", "seconds")
CPU_SECONDS: Final = Cost(
    "cpu_seconds", "cpu_seconds", "CPU seconds of training", "s CPU", "CPU seconds"
)
VIEWS: Final = Cost("views", "views", "rendered training views", "views", "views")
STEPS: Final = Cost("steps", "step", "optimizer steps", "steps", "steps")
COSTS: Final = (SECONDS, CPU_SECONDS, VIEWS, STEPS)

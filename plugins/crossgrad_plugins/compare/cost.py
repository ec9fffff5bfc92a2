"""Costs of a run: seconds of the clock or of the processor, views, steps."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Final


class ClockChoice(StrEnum):
    """Which seconds are compared."""

    AUTO = "auto"
    WALL = "wall"
    CPU = "cpu"
    NONE = "none"


@dataclass(frozen=True)
class Cost:
    """One thing that runs spend.

    Attributes:
        name: Its name in tables and file names.
        column: Its column in metrics.csv.
        axis: What the axis of a figure is called.
        unit: Its unit, such as `s`.
        title: How it stands in a sentence: "at equal TITLE".
    """

    name: str
    column: str
    axis: str
    unit: str
    title: str

    def shown(self, amount: float) -> str:
        """An amount with its unit."""
        number = f"{amount:,.0f}" if amount >= _WHOLE or self.unit != "s" else f"{amount:.3g}"
        return f"{number} {self.unit}"


#: Amounts of seconds from here on are shown without decimals.
_WHOLE: Final = 10.0

SECONDS: Final = Cost("seconds", "train_seconds", "training seconds", "s", "seconds")
CPU_SECONDS: Final = Cost(
    "cpu_seconds", "cpu_seconds", "CPU seconds of training", "s CPU", "CPU seconds"
)
VIEWS: Final = Cost("views", "views", "training views rendered", "views", "views")
STEPS: Final = Cost("steps", "step", "optimizer steps", "steps", "steps")
COSTS: Final = (SECONDS, CPU_SECONDS, VIEWS, STEPS)

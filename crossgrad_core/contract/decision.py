"""One row of the table of decided settings, and the run length on which decisions depend."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, TypeAlias

#: Settings that are decided again if a time budget makes a run longer or shorter.
FOLLOWING: Final = ("rate_factor", "growth", "max_gaussians", "min_refinements", "sh_start")


@dataclass(frozen=True)
class Decision:
    """One row of the table of decided settings.

    Attributes:
        setting: A setting of a run, or an option of a component, such as `densifier.division`.
        value: The value of the setting.
        because: The reason, in a few words.
        evidence: The facts or the results that support the reason.
        override: The option that sets another value. Empty if the value is the published value. The
            terminal does not show decisions without an override.
    """

    setting: str
    value: Any
    because: str
    evidence: str = ""
    override: str = ""


@dataclass(frozen=True)
class Length:
    """The length of a run and its number of primitives, on which decisions depend.

    Attributes:
        planned: Planned number of steps.
        total: Present number of steps. The number differs from `planned` if a time budget made the
            run longer or shorter.
        start: Number of primitives at the start; None before they are counted.
    """

    planned: int
    total: int
    start: int | None = None


#: Length of a run -> the table of decided settings.
Decide: TypeAlias = Callable[[Length], tuple[Decision, ...]]


def repeats(_: Length) -> tuple[Decision, ...]:
    """Return the empty table of decisions for a run that repeats another run."""
    return ()

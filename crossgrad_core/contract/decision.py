"""One row of the table of decided settings, and the length of the run that it depends on."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, TypeAlias

#: Settings that follow the length if the clock makes a run longer or shorter.
FOLLOWING: Final = ("rate_factor", "growth", "max_gaussians", "min_refinements", "sh_start")


@dataclass(frozen=True)
class Decision:
    """One row of the table of decided settings.

    Attributes:
        setting: A setting of a run, or an option of a component, such as `densifier.division`.
        value: Its value.
        because: Why, in a few words.
        evidence: The facts or the results that the reason rests on.
        override: The option that sets another value; empty if the value is the published one, which
            the terminal does not report.
    """

    setting: str
    value: Any
    because: str
    evidence: str = ""
    override: str = ""


@dataclass(frozen=True)
class Length:
    """The length of a run as far as decisions depend on it.

    Attributes:
        planned: Steps that the run was planned with.
        total: Steps that it has now, after the clock made it longer or shorter.
        start: Primitives at the start; None before they are counted.
    """

    planned: int
    total: int
    start: int | None = None


#: Length of a run -> the table of decided settings.
Decide: TypeAlias = Callable[[Length], tuple[Decision, ...]]


def repeats(_: Length) -> tuple[Decision, ...]:
    """The table of a run that repeats another one: nothing is open."""
    return ()

"""One decision of the planner: what, on what evidence, by which rule, and how to overrule it."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import isfinite
from typing import Literal, TypeAlias

from crossgrad_core.plugin import Json

#: Figures that a decision rests on, by name.
Figures: TypeAlias = Mapping[str, float]
#: Settings as options are called.
Settings: TypeAlias = Mapping[str, Json]
#: How a decision came about: the evidence decided; the default stays, since the evidence is missing
#: or undecided; or the user set it.
Basis: TypeAlias = Literal["decided", "default", "given"]
#: What a decision saves that is what a run does anyway.
NOTHING = "-"


@dataclass(frozen=True)
class Decision:
    """A part of a run, what it is to be, and why.

    Attributes:
        part: What is decided.
        choice: What it is to be.
        basis: How that came about.
        evidence: What was found out, with its figure.
        rule: The threshold.
        source: Where the rule is from.
        saved: What the decision saves against having the part.
        force: The option that overrules it.
        figures: The figures of the evidence.
        settings: Settings that the decision changes -> their value, as options are called; none
            where it is what a run does anyway.
        seconds: How long it took to decide.
    """

    part: str
    choice: str
    basis: Basis
    evidence: str
    rule: str
    source: str
    force: str
    saved: str = NOTHING
    figures: Figures = field(default_factory=dict)
    settings: Settings = field(default_factory=dict)
    seconds: float = 0.0

    def found(
        self,
        evidence: str,
        *,
        decided: bool = False,
        saved: str = NOTHING,
        figures: Figures | None = None,
    ) -> "Decision":
        """The same choice with its evidence.

        Args:
            evidence: What was found out.
            decided: Whether that decides, or the default stays without it.
            saved: What the choice saves.
            figures: The figures of the evidence.
        """
        basis: Basis = "decided" if decided else "default"
        return replace(
            self, evidence=evidence, basis=basis, saved=saved, figures=dict(figures or {})
        )

    def changed(
        self, choice: str, settings: Settings, force: str, saved: str = NOTHING
    ) -> "Decision":
        """Another choice on the same evidence, which decides.

        Args:
            choice: What the part is to be.
            settings: The settings that change.
            force: The option that overrules it.
            saved: What the choice saves.
        """
        return replace(
            self, choice=choice, basis="decided", settings=settings, force=force, saved=saved
        )

    def took(self, seconds: float) -> "Decision":
        """The decision with the seconds that it took."""
        return replace(self, seconds=round(seconds, 3))

    def as_data(self) -> dict[str, Json]:
        """Plain data for JSON, in which what is not finite is null."""
        finite: dict[str, Json] = {
            name: each if isfinite(each) else None for name, each in self.figures.items()
        }
        return {
            "part": self.part,
            "decision": self.choice,
            "basis": self.basis,
            "evidence": self.evidence,
            "figures": finite,
            "rule": self.rule,
            "source": self.source,
            "cost_saved": self.saved,
            "force_with": self.force,
            "settings": dict(self.settings),
            "seconds": self.seconds,
        }

    def note(self) -> str:
        """A line for the notes of a run."""
        return f"plan: {self.part}: {self.choice}; {self.evidence} ({self.force} overrules it)"


def given(part: str, choice: object, force: str) -> Decision:
    """The decision of the user, which wins; nothing was looked at."""
    return Decision(part, str(choice), "given", "set by you", "what you set wins", "you", force)

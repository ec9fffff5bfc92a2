"""Findings of the planner: the evidence on one part of a run, and the settings that follow."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import isfinite
from typing import Literal, TypeAlias

from crossgrad_core.plugin import Decision, Json

#: The figures of a finding, by name.
Figures: TypeAlias = Mapping[str, float]
#: Setting, or option of a component -> value.
Settings: TypeAlias = Mapping[str, Json]
#: How a choice came about: the evidence decided; the default stays, because evidence is missing or
#: undecided; or the user set it.
Basis: TypeAlias = Literal["decided", "default", "given"]
#: The saving of a choice that a run without a plan makes, too.
NOTHING = "-"


@dataclass(frozen=True)
class Finding:
    """The choice for one part of a run, with its evidence.

    Attributes:
        part: The part of the run.
        choice: What it will be.
        basis: How the choice came about.
        evidence: What was found out, with its figure.
        rule: The threshold.
        source: Where the rule is from.
        saved: What the choice saves compared with a run that has the part.
        force: The option that sets another choice.
        figures: The figures of the evidence.
        settings: The settings that change; none if the choice is the default.
        because: Why they change, in a few words.
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
    because: str = ""

    def found(
        self,
        evidence: str,
        *,
        decided: bool = False,
        saved: str = NOTHING,
        figures: Figures | None = None,
    ) -> "Finding":
        """Return the same choice with its evidence.

        Args:
            evidence: What was found out.
            decided: Whether the evidence decides; if not, the default stays without it.
            saved: What the choice saves.
            figures: The figures of the evidence.
        """
        basis: Basis = "decided" if decided else "default"
        return replace(
            self, evidence=evidence, basis=basis, saved=saved, figures=dict(figures or {})
        )

    def changed(
        self, choice: str, settings: Settings, because: str, force: str, saved: str = NOTHING
    ) -> "Finding":
        """Return another choice on the same evidence, which decides.

        Args:
            choice: What the part will be.
            settings: The settings that change.
            because: Why, in a few words.
            force: The option that sets another choice.
            saved: What the choice saves.
        """
        return replace(
            self,
            choice=choice,
            basis="decided",
            settings=settings,
            because=because,
            force=force,
            saved=saved,
        )

    @property
    def decisions(self) -> list[Decision]:
        """One row for each setting that changes; the terminal reports the first one."""
        return [
            Decision(name, value, self.because, self.evidence, "" if row else self.force)
            for row, (name, value) in enumerate(self.settings.items())
        ]

    def as_data(self) -> dict[str, Json]:
        """Return plain data for JSON; figures that are not finite become null."""
        finite: dict[str, Json] = {
            name: figure if isfinite(figure) else None for name, figure in self.figures.items()
        }
        return {
            "part": self.part,
            "decision": self.choice,
            "basis": self.basis,
            "because": self.because,
            "evidence": self.evidence,
            "figures": finite,
            "rule": self.rule,
            "source": self.source,
            "cost_saved": self.saved,
            "force_with": self.force,
            "settings": dict(self.settings),
        }


def given(part: str, choice: object, force: str) -> Finding:
    """Return the choice of the user, which wins without a look at the scene."""
    return Finding(part, str(choice), "given", "set by you", "what you set wins", "you", force)

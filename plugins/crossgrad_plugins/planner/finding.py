"""Findings of the planner: the evidence about a part of a run, and the settings that follow."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import isfinite
from typing import Literal, TypeAlias

from crossgrad_core.plugin import Decision, Json

#: Name of a piece of evidence -> its value.
Figures: TypeAlias = Mapping[str, float]
#: Name of a setting or of a component's option -> value.
Settings: TypeAlias = Mapping[str, Json]
#: Origin of a choice: `decided` if the evidence decides, `default` if the evidence is missing or
#: not conclusive, `given` if the user set the choice.
Basis: TypeAlias = Literal["decided", "default", "given"]
#: This text replaces the saved cost if a run without the planner would make the same choice.
NOTHING = "-"


@dataclass(frozen=True)
class Finding:
    """The choice for a part of a run, with its evidence.

    Attributes:
        part: The part of the run, such as exposure.
        choice: The choice for the part.
        basis: The origin of the choice.
        evidence: The evidence as text.
        rule: The threshold that the evidence is compared with.
        source: The source of the rule.
        saved: The cost that the choice saves, compared with a run that uses the part.
        force: The option with which the user makes another choice.
        figures: The values of the evidence.
        settings: The settings that change; empty if the choice is the default.
        because: The reason for the change in a few words.
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
        """Return the default choice with its evidence.

        Args:
            evidence: The evidence as text.
            decided: True if the evidence decides; False if the default is kept without a decision.
            saved: The cost that the choice saves.
            figures: The values of the evidence, by name.
        """
        basis: Basis = "decided" if decided else "default"
        return replace(
            self, evidence=evidence, basis=basis, saved=saved, figures=dict(figures or {})
        )

    def changed(
        self, choice: str, settings: Settings, because: str, force: str, saved: str = NOTHING
    ) -> "Finding":
        """Return the finding with another choice that the same evidence decides.

        Args:
            choice: The choice for the part.
            settings: The settings that change.
            because: The reason in a few words.
            force: The option with which the user makes another choice.
            saved: The cost that the choice saves.
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
        """One decision for each setting that changes; the terminal shows the first one."""
        return [
            Decision(name, value, self.because, self.evidence, "" if row else self.force)
            for row, (name, value) in enumerate(self.settings.items())
        ]

    def as_data(self) -> dict[str, Json]:
        """Return plain data for JSON; non-finite values become null."""
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
    """Return the finding for a choice of the user, which needs no evidence."""
    return Finding(
        part, str(choice), "given", "set by you", "your own setting has priority", "you", force
    )

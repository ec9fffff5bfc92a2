"""All findings about a scene, and the settings of a run that follow from the findings."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from time import perf_counter
from typing import Any, Final

from crossgrad_core.commands import RunConfig, layered
from crossgrad_core.plugin import Decision, Json, Scene
from crossgrad_plugins.planner import appearance, data, grouping, length, view_schedule
from crossgrad_plugins.planner.evidence import Evidence
from crossgrad_plugins.planner.finding import Finding, Settings

#: The functions that make the decisions, in the order of the table.
PARTS: Final[tuple[Callable[[Evidence], Finding], ...]] = (
    *(grouping.modes, grouping.pairs, view_schedule.view_schedule),
    *(grouping.views_per_step, grouping.operator),
    *(appearance.exposure, appearance.degree, appearance.scale_filter, length.length),
    *(data.start, data.held_out, data.undistortion, data.masks, data.background),
)


@dataclass(frozen=True)
class Plan:
    """The findings about all parts of a run.

    Attributes:
        scene: Name of the scene.
        findings: One finding for each part.
        seconds: Time that the planner took, in seconds.
    """

    scene: str
    findings: tuple[Finding, ...]
    seconds: float

    @property
    def decisions(self) -> list[Decision]:
        """The decisions that change settings."""
        return [row for finding in self.findings for row in finding.decisions]

    @property
    def settings(self) -> Settings:
        """The changed settings with their values."""
        return {row.setting: row.value for row in self.decisions}

    def of_part(self, part: str) -> Finding:
        """Return the finding about a part."""
        return next(finding for finding in self.findings if finding.part == part)

    def applied_to(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Return the settings of a run in their long form, with the planned changes."""
        decided, seconds = dict(self.settings), settings.get("seconds")
        if "max_views" in decided and seconds is not None:
            # Merge the settings one after the other. Settings that give a length replace an earlier
            # length.
            decided["seconds"] = seconds
        return layered([settings, decided])

    def as_data(self) -> dict[str, Json]:
        """Return plain data for JSON."""
        return {
            "scene": self.scene,
            "seconds": round(self.seconds, 3),
            "settings": dict(self.settings),
            "decisions": [finding.as_data() for finding in self.findings],
        }


def plan_of(config: RunConfig, scene: Scene, probe_seconds: float | None = None) -> Plan:
    """Plan a run on a scene; the user's settings are kept.

    Args:
        config: The configuration with only the user's settings.
        scene: The scene of the run.
        probe_seconds: Training time of a probe in seconds; None for no probe.

    Raises:
        UserError: A photo cannot be decoded.
    """
    begun = perf_counter()
    evidence = Evidence(config, scene, probe_seconds)
    findings = tuple(decide(evidence) for decide in PARTS)
    return Plan(scene.name, findings, perf_counter() - begun)


def planned(config: RunConfig, scene: Scene) -> list[Decision]:
    """Return the decisions that follow from the scene, for `--plan auto`.

    Raises:
        UserError: A photo cannot be decoded.
    """
    return plan_of(config, scene).decisions

"""All decisions for a scene, and what they make of a run's settings."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from time import perf_counter
from typing import Any, Final, TypeAlias

from crossgrad_core.commands import RunConfig, configured, layered
from crossgrad_core.plugin import Json, Scene
from crossgrad_plugins.planner import groups, looks, reading, sizes, turns
from crossgrad_plugins.planner.decision import Decision, Settings
from crossgrad_plugins.planner.evidence import Evidence

Parts: TypeAlias = tuple[Callable[[Evidence], Decision], ...]
#: What decides each part, in the order of the table.
PARTS: Final[Parts] = (
    *(groups.modes, groups.pairs, turns.turns, groups.views_per_step, groups.operator),
    *(looks.exposure, looks.degree, looks.scale_filter),
    *(sizes.resolution, sizes.count, sizes.length, sizes.densifier, sizes.dropout),
    *(reading.start, reading.held_out, reading.undistortion, reading.masks, reading.background),
)


@dataclass(frozen=True)
class Plan:
    """The decisions on all parts of a run on a scene.

    Attributes:
        scene: Name of the scene.
        decisions: One for each part.
        seconds: How long they took, all together.
    """

    scene: str
    decisions: tuple[Decision, ...]
    seconds: float

    @property
    def settings(self) -> Settings:
        """The settings that change, as options are called."""
        return {name: value for each in self.decisions for name, value in each.settings.items()}

    def of_part(self, part: str) -> Decision:
        """The decision on a part."""
        return next(each for each in self.decisions if each.part == part)

    def applied_to(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        """A run's settings in their long form with what is decided."""
        decided, seconds = dict(self.settings), settings.get("seconds")
        if "max_views" in decided and seconds is not None:
            # A later length replaces those of before, and this one is within the seconds.
            decided["seconds"] = seconds
        return layered([settings, decided])

    def notes(self) -> Iterator[str]:
        """What a run tells its user: what changes, and what was set and stays."""
        yield from (each.note() for each in self.decisions if each.settings)

    def as_data(self) -> dict[str, Json]:
        """Plain data for JSON."""
        return {
            "scene": self.scene,
            "seconds": round(self.seconds, 3),
            "settings": dict(self.settings),
            "notes": list(self.notes()),
            "decisions": [each.as_data() for each in self.decisions],
        }


def plan_of(
    config: RunConfig, scene: Scene, probe_seconds: float | None = None, parts: Parts = PARTS
) -> Plan:
    """What the scene calls for; what the user set stays as it is.

    Args:
        config: The configuration, in which only what the user set is set.
        scene: Its scene.
        probe_seconds: Training seconds of a probe; None for none.
        parts: What is decided.

    Raises:
        UserError: A photo cannot be decoded.
    """
    begun = perf_counter()
    evidence = Evidence(config, scene, probe_seconds)
    decisions = tuple(_timed(part, evidence) for part in parts)
    return Plan(scene.name, decisions, perf_counter() - begun)


def planned(config: RunConfig, scene: Scene) -> tuple[RunConfig, Mapping[str, Json]]:
    """What `--plan` makes of a run: its configuration with the decisions, and the plan.

    Raises:
        UserError: A photo cannot be decoded.
    """
    plan = plan_of(config, scene, parts=PARTS if config.plan == "auto" else (turns.turns,))
    if not plan.settings:
        return config, plan.as_data()
    return configured(plan.applied_to(config.model_dump(exclude_unset=True))), plan.as_data()


def _timed(part: Callable[[Evidence], Decision], evidence: Evidence) -> Decision:
    begun = perf_counter()
    decision = part(evidence)
    return decision.took(perf_counter() - begun)

"""Recipe `published`: the rules of the original 3DGS code, for any length of the run."""

from collections.abc import Mapping
from typing import Any, ClassVar, Final

from typing_extensions import override

from crossgrad_core.plugin import Decision, Facts, Recipe, Unit

#: Near plane of the original code, in units of the scene's original frame.
NEAR: Final = 0.2
BECAUSE: Final = "as published"
#: Settings that are the same for all runs.
VALUES: Final[Mapping[str, Any]] = {
    "initializer": "points",
    "exposure": "none",
    "resolution": "full",
    "growth": "unbounded",
    "min_refinements": 0,
    "sh_start": 0.0,
    "position_lr": "extent",
    "rate_factor": 1.0,
    "few_pass_rates": False,
    "beta1": 0.9,
    "beta2": 0.999,
    "step_order": "densify-first",
    "rasterizer.footprint": "3-sigma",
}


class Published(Recipe):
    """Uses the rules of the published code.

    These are its order of operations in a step, footprint of 3 sigma, near plane, learning rates
    and schedule.
    """

    settings: ClassVar[Mapping[str, Any]] = {"plan": "off"}
    rasterizer_options: ClassVar[frozenset[str]] = frozenset({"footprint"})

    @override
    def decide(self, facts: Facts) -> list[Decision]:
        unit: Unit = facts.given.get("schedule_unit") or "steps"
        named = facts.given.get("densifier")
        name = facts.backbone.default_densifier if named is None else named.name
        resets = facts.densifier(name).window(facts.schedule(unit)).reset_every or 0
        values = {
            **VALUES,
            "views_per_step": facts.views_per_step.setting,
            "densifier": name,
            "schedule_unit": unit,
            "max_gaussians": 0,
            "reset_every": resets,
            "rasterizer.near": NEAR * facts.scale,
        }
        rows = [Decision(setting, value, BECAUSE, "3DGS") for setting, value in values.items()]
        return [*rows, *facts.intervals()]

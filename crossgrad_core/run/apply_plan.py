"""`--plan`: a planner decides settings by the scene, before a run is assembled."""

import logging
from collections.abc import Callable, Mapping
from typing import TypeAlias, cast

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.blocks import Json
from crossgrad_core.contract.scene import Scene
from crossgrad_core.defaults import PLANNER
from crossgrad_core.registry.entries import find, resolve_entry
from crossgrad_core.registry.slots import PLANNERS

_LOG = logging.getLogger(__name__)
#: What a planner decided, as plain data: `seconds` that it took, `notes` for the user, and
#: `decisions`, whatever else it says of each.
Plan: TypeAlias = Mapping[str, Json]
#: A planner: the configuration, in which only what the user set is set, and the scene -> the
#: configuration with its decisions, and the plan. `plan` of the configuration says what it may
#: decide: `auto` all, `turns` how often far and near views come.
Planner: TypeAlias = Callable[[RunConfig, Scene], tuple[RunConfig, Plan]]


def planned(config: RunConfig, scene: Scene) -> tuple[RunConfig, Plan]:
    """Return the configuration with the planner's decisions, which repeats the run, and the plan.

    Raises:
        UserError: There is no planner, it cannot be imported, or a photo cannot be decoded.
    """
    _LOG.info("looking at what the scene needs")
    decided, plan = cast("Planner", resolve_entry(find(PLANNERS, PLANNER)))(config, scene)
    return decided.model_copy(update={"plan": "off"}), plan


def notes_of(plan: Plan | None) -> tuple[str, ...]:
    """What the user should know of a plan."""
    notes = (plan or {}).get("notes")
    return tuple(map(str, notes)) if isinstance(notes, list) else ()


def seconds_of(plan: Plan | None) -> float:
    """How long it took to decide; 0 where nothing was."""
    seconds = (plan or {}).get("seconds")
    return float(seconds) if isinstance(seconds, int | float) else 0.0

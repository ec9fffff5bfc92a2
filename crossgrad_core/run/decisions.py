"""The facts from which a recipe decides, and the functions that make the table of decisions."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from typing import TypeAlias, cast

from crossgrad_core.config import ComponentChoice, RunConfig
from crossgrad_core.contract.decision import Decide, Decision, Length, repeats
from crossgrad_core.contract.scene import Scene
from crossgrad_core.contract.slots.densifier import Densifier
from crossgrad_core.contract.slots.rasterizer import Rasterizer
from crossgrad_core.contract.slots.recipe import Facts
from crossgrad_core.defaults import PLANNER
from crossgrad_core.recipe.table import (
    applied,
    decide,
    given_settings,
    is_complete,
    open_again,
    rows_of,
)
from crossgrad_core.registry.entries import find, load, resolve_entry
from crossgrad_core.registry.slots import PLANNERS
from crossgrad_core.run.devices import with_device
from crossgrad_core.run.rasterizers import Wanted, choose_rasterizer
from crossgrad_core.run.select import chosen, fitted_backbone, rules_of, views_per_step_of
from crossgrad_core.scene.shown_points import photos_per_point
from crossgrad_core.training.numbers import Numbers
from crossgrad_core.training.setup import Setup

_LOG = logging.getLogger(__name__)
#: Function of a planner. The function receives the configuration (only the user's settings) and the
#: scene, and returns the decisions on settings that depend on the scene.
Planner: TypeAlias = Callable[[RunConfig, Scene], Sequence[Decision]]
#: Default length of a run if neither steps nor views nor seconds are set (3DGS).
DEFAULT_STEPS = 30_000


def facts_of(config: RunConfig, scene: Scene) -> Facts:
    """Return the facts about a run.

    Args:
        config: The configuration with only the user's settings.
        scene: The scene of the run.

    Raises:
        UserError: A component is wrong, or no rasterizer runs on the device.
    """
    views, because = views_per_step_of(config)
    backbone, _ = fitted_backbone(config, scene)
    device = with_device(config)[0].device.partition(":")[0]
    rasterizer, _ = choose_rasterizer(config.rasterizer.name, Wanted(device, backbone.response))
    options = {} if config.densifier is None else config.densifier.options
    steps = config.steps if config.max_views is None else max(1, views.steps_of(config.max_views))
    planned = steps or DEFAULT_STEPS
    return Facts(
        device=device,
        planned=None if config.seconds is not None else planned,
        total=DEFAULT_STEPS if config.seconds is not None else planned,
        mode=config.schedule,
        schedule_length=config.schedule_length,
        views_per_step=views,
        views_because=because,
        photos=len(scene.train_views),
        pixels=scene.train_pixels,
        photos_per_point=photos_per_point(scene),
        own_points=config.data.init == "points",
        batched=config.batch_rule != "none",
        scale=scene.similarity.scale,
        start=None,
        backbone=backbone,
        densifier=lambda name: chosen(Densifier, ComponentChoice(name=name, **options)),
        provides=load(Rasterizer, rasterizer).provides,
        given=given_settings(config),
    )


def with_decisions(
    config: RunConfig, scene: Scene
) -> tuple[RunConfig, tuple[Decision, ...], Decide]:
    """Return the configuration with the decisions, the table, and a function that renews the table.

    With `--plan auto`, the planner's decisions about the scene come first. The recipe treats these
    decisions like settings of the user.

    Raises:
        UserError: There is no planner, a photo cannot be decoded, or the recipe does not decide a
            setting; see also `facts_of`.
    """
    if config.seconds is not None:
        # Plan the number of steps for the time budget again, and decide again all settings that
        # depend on the length.
        config = open_again(config)
    if is_complete(config):
        return config, rows_of(config), repeats
    of_scene: tuple[Decision, ...] = ()
    if config.plan != "off":
        _LOG.info("checking which components the scene needs")
        planner = cast("Planner", resolve_entry(find(PLANNERS, PLANNER)))
        of_scene = tuple(planner(config, scene))
        config = applied(config, of_scene, PLANNER)
    facts = facts_of(config, scene)
    rows = decide(config, facts)

    def again(length: Length) -> tuple[Decision, ...]:
        return decide(config, replace(facts, **vars(length)))

    return applied(config, rows), (*of_scene, *rows), again


def table_of(config: RunConfig, scene: Scene, start: int | None = None) -> dict[str, Decision]:
    """Return setting -> decision for the settings that the user left open.

    Args:
        config: The configuration with only the user's settings.
        scene: The scene of the run.
        start: Number of primitives at the start, if it is already known.

    Raises:
        UserError: See `with_decisions`.
    """
    rows = decide(config, replace(facts_of(config, scene), start=start))
    return {row.setting: row for row in rows}


def redecided(setup: Setup, planned: int, start: int | None = None) -> Setup:
    """Return the setup with numeric settings and rules decided again for a newly planned length.

    All components except the rules stay the same.

    Args:
        setup: The run.
        planned: New planned number of steps.
        start: Number of primitives at the start; None before they are counted.
    """
    numbers = {field.name for field in fields(Numbers)}
    rows = {row.setting: row for row in setup.decide(Length(planned, planned, start))}
    table = {row.setting: row for row in setup.decisions}
    changed = {
        name: row for name, row in rows.items() if name in numbers or name.startswith("rules.")
    }
    config = applied(setup.config, tuple(changed.values()))
    setup = replace(setup, config=config, decisions=tuple((table | changed).values()))
    return setup.with_rules(rules_of(config))

"""The complete configuration of a run, including all decisions."""

from pathlib import Path
from typing import Any, Literal

from crossgrad_core.config import ComponentChoice, RunConfig
from crossgrad_core.contract.component import Component
from crossgrad_core.defaults import PROGRESS
from crossgrad_core.training.setup import Setup

#: Slots that every run fills with one component.
ALWAYS = (
    *("backbone", "sampler", "densifier", "rasterizer"),
    *("loss", "exposure", "initializer", "resolution", "exporter"),
)


def resolved(setup: Setup) -> RunConfig:
    """Return the configuration that repeats the run, with all options, K and the number of steps.

    The configuration contains no output folder, so that the repeated run gets a new folder.
    """
    config, selection = setup.config, setup.selection
    components, names = selection.components, selection.names
    chosen: dict[str, Any] = {slot: _choice(names[slot], components[slot]) for slot in ALWAYS}
    if "grouping" in components:
        chosen["grouping"] = _choice(names["grouping"], components["grouping"])
    scene = None if config.scene is None else Path(config.scene).resolve()
    data, path = config.data, config.data.init_file
    located = {
        "init": data.init if path is None else str(path.resolve()),
        "points": _located(data.points),
        "masks": _located(data.masks),
    }
    exposure_run = config.exposure_from
    return config.model_copy(
        update={
            **chosen,
            "operator": _operator(config, setup),
            "reader": config.reader.model_copy(update={"name": names["reader"]}),
            "metrics": tuple(_choice(name, metric) for name, metric in selection.metrics.items()),
            "observers": tuple(c for c in config.observers if c.name != PROGRESS),
            "rules": {name: _options(selection.rules.get(name)) for name in config.rules},
            "scene": scene,
            "data": data.model_copy(update=located),
            "exposure_from": None if exposure_run is None else exposure_run.resolve(),
            "out": None,
            "views_per_step": selection.views.setting,
            "steps": None if config.seconds else config.steps or setup.schedule.total,
            "sh_from": setup.schedule.sh_from,
        }
    )


def _located(path: Path | None) -> Path | None:
    """Return the absolute path if the path exists; a path relative to the scene is unchanged."""
    return path.resolve() if path is not None and path.exists() else path


def _choice(name: str, component: Component) -> ComponentChoice:
    return ComponentChoice.model_validate({"name": name, **component.model_dump(mode="json")})


def _options(rule: Component | None) -> dict[str, Any] | Literal[False]:
    return False if rule is None else rule.model_dump(mode="json")


def _operator(config: RunConfig, setup: Setup) -> ComponentChoice | tuple[ComponentChoice, ...]:
    if isinstance(config.operator, tuple) and len(config.operator) > 1:
        return config.operator
    return _choice(setup.selection.names["operator"], setup.operator)

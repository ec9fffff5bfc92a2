"""The choice of the components of a run and of the number of views per step."""

from pathlib import Path
from typing import Final, TypeVar

from crossgrad_core.config import AUTO, ComponentChoice, RunConfig
from crossgrad_core.contract.component import Component, answered, pair
from crossgrad_core.contract.scene import Scene, is_in_image
from crossgrad_core.contract.schedule import ViewsPerStepSpec
from crossgrad_core.contract.selection import Selection
from crossgrad_core.contract.slots.backbone import Backbone
from crossgrad_core.contract.slots.densifier import Densifier
from crossgrad_core.contract.slots.exporter import Exporter
from crossgrad_core.contract.slots.exposure import Exposure, Fitted
from crossgrad_core.contract.slots.grouping import Grouping
from crossgrad_core.contract.slots.initializer import Initializer
from crossgrad_core.contract.slots.loss import Loss
from crossgrad_core.contract.slots.metric import Metric
from crossgrad_core.contract.slots.operator import Operator
from crossgrad_core.contract.slots.rasterizer import Rasterizer
from crossgrad_core.contract.slots.resolution import Resolution
from crossgrad_core.contract.slots.rule import Rule
from crossgrad_core.contract.slots.sampler import Sampler
from crossgrad_core.defaults import CHAIN, INITIALIZER_WITHOUT_POINTS, METRICS
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import build, load
from crossgrad_core.run.devices import choose_device
from crossgrad_core.run.rasterizers import choose_rasterizer, demands
from crossgrad_core.run.results.metrics_csv import columns_for
from crossgrad_core.scene.point_cloud import CLOUDS
from crossgrad_core.wording import listed

#: The base class of a slot.
C = TypeVar("C", bound=Component)
#: Upper limit (exclusive) of the search for a K that sampler and operator support.
_MOST_VIEWS: Final = 13


def select(config: RunConfig, scene: Scene, reader: str) -> tuple[Selection, list[str]]:
    """Return the components, fitted to the scene, and messages about the choices.

    Raises:
        UserError: A name or option is wrong.
    """
    start = chosen(Initializer, config.initializer)
    _require_points(config, scene, start)
    _require_shown_points(config, scene, start)
    device = choose_device(config.device)
    notes: list[str] = list(scene.notes)
    sampler = chosen(Sampler, config.sampler)
    operator, operator_name = operator_of(config)
    backbone, left_out = fitted_backbone(config, scene)
    notes += left_out
    views, _ = views_per_step_of(config)
    densifier = chosen(Densifier, config.densifier)
    wanted = demands(config, device.type, backbone, densifier)
    rasterizer_name, choosing = choose_rasterizer(config.rasterizer.name, wanted)
    notes += choosing
    _require_decided_options(config, rasterizer_name)
    rasterizer = build(Rasterizer, rasterizer_name, config.rasterizer.options)
    resolution = chosen(Resolution, config.resolution)
    grouping_choice = _grouping_choice(config, sampler, operator, notes)
    exposure = chosen(Exposure, config.exposure)
    fitted = answered(exposure.fitted_to(scene), Fitted, exposure, "fitted_to")
    notes += fitted.notes
    names = {
        "backbone": config.backbone.name,
        "sampler": config.sampler.name,
        "operator": operator_name,
        "densifier": _name(config.densifier),
        "rasterizer": rasterizer_name,
        "loss": config.loss.name,
        "exposure": fitted.name or _name(config.exposure),
        "initializer": _name(config.initializer),
        "resolution": _name(config.resolution),
        "exporter": config.exporter.name,
        "reader": reader,
    }
    grouping = None
    if grouping_choice is not None:
        grouping = chosen(Grouping, grouping_choice)
        names["grouping"] = grouping_choice.name
    selection = Selection(
        backbone=backbone,
        sampler=sampler,
        operator=operator,
        densifier=densifier,
        rasterizer=rasterizer,
        loss=chosen(Loss, config.loss),
        exposure=fitted.exposure,
        initializer=start,
        resolution=resolution.fitted_to(scene),
        exporter=chosen(Exporter, config.exporter),
        metrics=_metrics(config, scene, notes),
        names=names,
        views_per_step=max(views.counts),
        device=device.type,
        grouping=grouping,
        view_plan=views,
        rules=rules_of(config),
    )
    return selection, notes


def rules_of(config: RunConfig) -> dict[str, Rule]:
    """Return the rules of a run by name."""
    return {rule.name: build(Rule, rule.name, rule.options) for rule in config.used_rules}


def _require_points(config: RunConfig, scene: Scene, start: Initializer) -> None:
    if not len(scene.points) and config.data.init == "points" and not start.alone:
        raise UserError(
            "the scene has no SfM points to start from",
            where=config.scene or scene.name,
            found=_clouds_in(config.scene),
            todo=f"find points in the photos (--initializer {INITIALIZER_WITHOUT_POINTS}), "
            "start from a point cloud (--points FILE), from the Gaussians of a PLY file "
            "(--init FILE.ply) or from random points (--init random)",
        )


def _clouds_in(folder: Path | None) -> str:
    """Describe the files in the scene's folder that may be point clouds."""
    files = sorted(folder.iterdir()) if folder is not None and folder.is_dir() else []
    names = [file.name for file in files if file.suffix.lower() in CLOUDS]
    return f"unused point clouds: {listed(names)}" if names else "no point cloud"


def _require_shown_points(config: RunConfig, scene: Scene, start: Initializer) -> None:
    if not len(scene.points) or config.data.init != "points" or start.alone:
        return
    if not any(is_in_image(view.camera, scene.points).any() for view in scene.train_views):
        raise UserError(
            "no SfM point of the scene is visible in a training photo, so nothing can be trained",
            where=config.scene or scene.name,
            expected="cameras that look at the points, in the same coordinate system",
            found=f"{len(scene.points):,} points, none of them visible in "
            f"{len(scene.train_views)} photos",
            todo="correct the model, or find points in the photos (--initializer "
            f"{INITIALIZER_WITHOUT_POINTS})",
        )


def _require_decided_options(config: RunConfig, name: str) -> None:
    """Refuse a rasterizer without an option that the recipe sets."""
    lacking = config.rasterizer.options.keys() - load(Rasterizer, name).model_fields.keys()
    if decided := sorted(option for option in lacking if f"rasterizer.{option}" in config.decided):
        raise UserError(
            f"rasterizer {name} has no option {listed(decided)}, which the recipe sets",
            where=f"--recipe {config.recipe.name}",
            expected="a rasterizer with this option",
            todo="leave --rasterizer out, so that `auto` chooses a rasterizer with the "
            "option, or choose another recipe",
        )


def fitted_backbone(config: RunConfig, scene: Scene) -> tuple[Backbone, tuple[str, ...]]:
    """Return the backbone of a run, fitted to its scene, and notes on the fitted options."""
    backbone = chosen(Backbone, config.backbone)
    return pair(backbone.fitted_to(scene), Backbone, tuple, backbone, "fitted_to")


def chosen(slot: type[C], choice: ComponentChoice | None) -> C:
    """Build the component that the user or the recipe chose."""
    return build(slot, _name(choice), {} if choice is None else choice.options)


def _name(choice: ComponentChoice | None) -> str:
    """Return the name of the chosen component, or `auto` without a choice."""
    return AUTO if choice is None else choice.name


def _metrics(config: RunConfig, scene: Scene, notes: list[str]) -> dict[str, Metric]:
    """Return the metrics by name; leave out a default metric whose column already exists.

    Raises:
        UserError: Two columns of metrics.csv would have the same name.
    """
    metrics: dict[str, Metric] = {}
    regimes = sorted({view.regime for view in scene.test_views})
    for name, choice in {choice.name: choice for choice in config.metrics}.items():
        metric = chosen(Metric, choice)
        _check_form(name, metric.described().form)
        columns = columns_for(regimes, [counted.figure for counted in (*metrics.values(), metric)])
        twice = sorted({column for column in columns if columns.count(column) > 1})
        if not twice:
            metrics[name] = metric
        elif name in METRICS.split("+"):
            notes.append(
                f"metric {name} is not computed: metrics.csv already has a column {listed(twice)}"
            )
        else:
            raise UserError(
                f"two columns of metrics.csv would have the same name: {listed(twice)}",
                where=f"metrics {listed((*metrics, name))}; regimes {listed(regimes)}",
                expected="a different column name for every metric and regime",
                todo=f"leave metric {name} out, or rename the folder of photos",
            )
    return metrics


def _check_form(name: str, form: str) -> None:
    try:
        format(0.0, form)
    except (TypeError, ValueError) as error:
        raise UserError(
            f"a value of metric {name} cannot be formatted",
            where="the format of the metric",
            expected="a format for floating-point numbers, such as .4f or .0f",
            found=repr(form),
            todo=f"repair the plugin, or leave metric {name} out",
        ) from error


def _or_default(choice: ComponentChoice | None, name: str) -> ComponentChoice:
    """Return the component choice; replace a missing name or `auto` by the default name."""
    if choice is None:
        return ComponentChoice(name=name)
    return choice.model_copy(update={"name": name}) if choice.name == AUTO else choice


def _grouping_choice(
    config: RunConfig, sampler: Sampler, operator: Operator, notes: list[str]
) -> ComponentChoice | None:
    if config.grouping is not None and config.grouping.name != AUTO:
        return config.grouping
    # Ignore the operator's default grouping if the sampler makes its own labels.
    of_operator = None if sampler.own_labels else operator.resolved_grouping
    name = sampler.default_grouping or of_operator
    if name is not None:
        return _or_default(config.grouping, name)
    if config.grouping is not None:
        raise UserError(
            "options of a grouping were given, but neither the sampler nor the operator "
            "uses a grouping",
            where="grouping",
            todo="choose a grouping with --grouping, or leave its options out",
        )
    notes.append(f"no grouping: sampler {config.sampler.name} draws from all views without groups")
    return None


def operator_of(config: RunConfig) -> tuple[Operator, str]:
    """Return the operator of a run and its name; several operators form a chain."""
    links = config.operators
    built = tuple(build(Operator, link.name, link.options) for link in links)
    operator = built[0] if len(built) == 1 else build(Operator, CHAIN, {"links": built})
    return operator, "+".join(link.name for link in links)


def views_per_step_of(config: RunConfig) -> tuple[ViewsPerStepSpec, str]:
    """Return the number of views K of each step, and a reason.

    The reason is empty, except if the operator changes the sampler's default K.

    If the user sets no K, K is the sampler's default. If the operator does not work with this K, K
    is the smallest number that both components support.
    """
    if config.view_plan is not None:
        return config.view_plan, ""
    sampler = build(Sampler, config.sampler.name, config.sampler.options)
    operator, _ = operator_of(config)
    default_views = sampler.resolved_views
    of_sampler = (k for k in range(1, _MOST_VIEWS) if sampler.view_counts.admits(k))
    both = [k for k in of_sampler if operator.views.admits(k)]
    # Do not raise K for the default operator, because it only sums the gradients.
    named = config.operator != RunConfig.model_fields["operator"].default
    chosen_views, why = default_views, ""
    if default_views not in both:
        # If no K is supported by both components, the later validation raises an error.
        chosen_views, why = next(iter(both), default_views), f"the operator needs {operator.views}"
    elif named and operator.needs_more_views(default_views):
        chosen_views = next((k for k in both if not operator.needs_more_views(k)), default_views)
        why = "with fewer views the operator has no effect"
    return ViewsPerStepSpec((chosen_views,)), why if chosen_views != default_views else ""

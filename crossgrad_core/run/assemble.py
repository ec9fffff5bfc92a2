"""From a configuration to a Setup: load, fit to the scene, object, or say what was left out."""

import logging
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import torch

from crossgrad_core.config import AUTO, ComponentChoice, RunConfig
from crossgrad_core.contract.adam_state import MOST_VIEWS
from crossgrad_core.contract.backbone import Backbone
from crossgrad_core.contract.component import Component, answered, pair
from crossgrad_core.contract.densifier import Densifier
from crossgrad_core.contract.exporter import Exporter
from crossgrad_core.contract.exposure import Exposure, Fitted
from crossgrad_core.contract.grouping import Grouping
from crossgrad_core.contract.loss import Loss
from crossgrad_core.contract.metric import Metric
from crossgrad_core.contract.objections import objections_to
from crossgrad_core.contract.observer import Observer
from crossgrad_core.contract.operator import Operator
from crossgrad_core.contract.pace import ViewPlan
from crossgrad_core.contract.poses import is_in_image
from crossgrad_core.contract.rasterizer import Rasterizer
from crossgrad_core.contract.reader import Reader
from crossgrad_core.contract.resolution import Resolution
from crossgrad_core.contract.sampler import Sampler
from crossgrad_core.contract.scene import Scene
from crossgrad_core.contract.selection import Selection
from crossgrad_core.contract.start import Start
from crossgrad_core.defaults import (
    BARE_START,
    EXPORTER,
    METRICS,
    READER,
    START,
    START_ALONE,
)
from crossgrad_core.errors import IncompatibleSelectionError, UserError
from crossgrad_core.registry.entries import build, entries, find, from_elsewhere, load
from crossgrad_core.registry.manager import make_manager
from crossgrad_core.registry.slots import GROUPS, LISTS
from crossgrad_core.run.idle import idle_note
from crossgrad_core.run.planning import notes_of, planned
from crossgrad_core.run.rasterizers import Wanted, choose_rasterizer
from crossgrad_core.run.results.metrics_csv import columns_for
from crossgrad_core.run.usual_resolution import usual_resolution
from crossgrad_core.run.usual_views import operator_of, usual_views
from crossgrad_core.training.dropout import with_dropout
from crossgrad_core.training.modes import mode_note
from crossgrad_core.training.rates import note_on_axes
from crossgrad_core.training.rates import notes_on as of_rates
from crossgrad_core.training.regrouping import labels_of
from crossgrad_core.training.rngs import make_streams
from crossgrad_core.training.scaled_photos import DevicePhotos, ScaledPhotos
from crossgrad_core.training.schedules import counting_of, notes_on_length, schedule_of
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.steady import notes_on as at_the_end
from crossgrad_core.wording import in_one_line, listed, plural, singular

_LOG = logging.getLogger(__name__)
#: The base class of a slot.
C = TypeVar("C", bound=Component)
#: Length of a run that asks for neither steps nor seconds (3DGS).
DEFAULT_STEPS = 30_000


def read_scene(config: RunConfig, path: Path) -> tuple[Scene, str]:
    """The scene and the name of the reader that read it.

    Raises:
        UserError: No reader accepts the folder, or several do, or one cannot read it.
    """
    _LOG.info("reading scene %s", path)
    name = config.reader.name
    if name == AUTO:
        able = [each for each in entries("readers") if accepts(each, path)]
        if len(able) > 1:
            raise UserError(
                "the scene can be read in several ways",
                where=path,
                found=f"files of the readers {listed(able)}",
                todo=f"choose one, such as --reader {able[0]}",
            )
        # No reader recognises it: the default one explains what it misses.
        name = able[0] if able else READER
    return build(Reader, name, config.reader.options).read(path, config.reading), name


def accepts(name: str, path: Path) -> bool:
    """Whether a reader takes the folder; one that fails does not keep the others from it."""
    try:
        return build(Reader, name, {}).accepts(path)
    except Exception as error:
        _LOG.warning("reader %s left out: %s", name, getattr(error, "what", in_one_line(error)))
        return False


def check_names(config: RunConfig) -> None:
    """Looks up every component and the device, before a large scene is read for nothing.

    Raises:
        UserError: A name does not exist, with the closest one that does.
    """
    choose_device(config.device)
    named = [("operators", link) for link in config.operators]
    named += [(slot, choice) for slot in LISTS for choice in getattr(config, slot)]
    single = (slot for slot in GROUPS if slot not in {"operators", *LISTS})
    named += [(slot, getattr(config, singular(slot))) for slot in single]
    for slot, choice in named:
        if choice is not None and choice.name != AUTO:
            find(slot, choice.name)


def choose_device(name: str) -> torch.device:
    """The torch device of that name.

    Raises:
        UserError: There is no such device on this machine.
    """
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise UserError(
            f"there is no device {name!r}",
            where="--device",
            expected="cpu, cuda or cuda:N",
            todo="leave --device out to run on the CPU",
        ) from error
    if device.type not in {"cpu", "cuda"}:
        raise UserError(
            f"device type {device.type!r} is not supported",
            where="--device",
            expected="cpu or cuda",
            todo="use --device cpu",
        )
    if device.type == "cuda":
        _require_cuda(device)
    return device


def _require_cuda(device: torch.device) -> None:
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if (device.index or 0) < count:
        return
    # A build of torch for AMD's GPUs calls them CUDA devices, too.
    built_for = torch.version.cuda or torch.version.hip
    if built_for is None:
        found, todo = "a build for CPUs only", "install a CUDA build of torch"
    elif count == 0:
        found = f"a build for CUDA {built_for}, but no GPU that it can use"
        todo = "run nvidia-smi: it tells whether there is a GPU and whether its driver works"
    else:
        found, todo = f"devices cuda:0 to cuda:{count - 1}", "choose one of them"
    raise UserError(
        f"torch sees no device {str(device)!r}",
        where="--device",
        found=f"torch {torch.__version__}: {found}",
        todo=f"use --device cpu, or {todo}",
    )


def assemble(config: RunConfig, scene: Scene, reader: str) -> Setup:
    """Everything that a configuration names, loaded, fitted to the scene and checked.

    Args:
        config: The configuration.
        scene: Its scene.
        reader: Name of the reader that read the scene.

    Raises:
        UserError: A name or option is wrong, or the components cannot work together.
    """
    plan = None
    if config.plan == AUTO:
        config, plan = planned(config, scene)
        scene = replace(scene, notes=(*scene.notes, *notes_of(plan)))
    config = _with_first_degree(config)
    selection, notes = select(config, scene, reader)
    observers = {choice.name: _built(Observer, choice) for choice in config.observers}
    plugins = _plugins(selection, observers)
    manager = make_manager(plugins)
    answers = manager.hook.crossgrad_objections(selection=selection)
    refuse(reasons_against(config, selection, answers))
    groups = _groups(config, scene, selection, notes)
    config = with_dropout(_with_steps(config, selection.views), scene, notes)
    counting = counting_of(
        config,
        selection.views,
        len(scene.train_views),
        budgeted=selection.densifier.budgeted,
    )
    steps = config.steps or DEFAULT_STEPS
    setup = Setup(
        config=config,
        scene=scene,
        selection=selection,
        manager=manager,
        plugins=plugins,
        groups=groups,
        schedule=schedule_of(config, selection.densifier, steps, counting),
        device=choose_device(config.device),
        notes=tuple(notes),
        scaled_photos=_photos(config),
        plan=plan,
    )
    # The length of a run within a budget is not known yet.
    timed = (*note_on_axes(setup), *notes_on_length(setup)) if config.seconds is None else ()
    named = {plural(word): [name] for word, name in selection.names.items()}
    named["operators"] = [each.name for each in config.operators]
    added = (
        *from_elsewhere({**named, "metrics": [*selection.metrics], "observers": [*observers]}),
        *_linear_note(setup),
        *idle_note(setup),
        *at_the_end(config),
        *of_rates(config, setup.schedule, len(scene.train_views)),
        *timed,
    )
    return replace(setup, notes=(*setup.notes, *added))


def _photos(config: RunConfig) -> ScaledPhotos | DevicePhotos:
    """Where photos are kept besides those that were decoded last."""
    mib, device = config.reading.cache_mib, choose_device(config.device)
    # At half the size photos take a quarter of the memory.
    scaled = ScaledPhotos(mib // 4)
    return scaled if device.type == "cpu" else DevicePhotos(scaled, device, mib)


def _with_first_degree(config: RunConfig) -> RunConfig:
    """The configuration that says at which SH degree the run starts.

    Written down, so that a run goes on without the file that it started from.
    """
    path = config.reading.init_file
    if config.sh_from is not None or path is None:
        return config
    degree = build(Exporter, EXPORTER, {}).sh_degree_of(path)
    return config.model_copy(update={"sh_from": degree})


def _with_steps(config: RunConfig, views: ViewPlan) -> RunConfig:
    """The configuration with a length in steps, where it has none in seconds.

    Views within seconds stay: whether there are seconds for them is known after the first steps.

    Raises:
        UserError: A single step draws more views.
    """
    if config.max_views is None:
        known = config.seconds is not None or config.steps is not None
        return config if known else config.model_copy(update={"steps": DEFAULT_STEPS})
    steps = views.steps_of(config.max_views)
    if steps == 0:
        raise UserError(
            "the run is shorter than its first step",
            where="--max-views",
            expected=f"at least {views.counts[0]}, the views of a step",
            found=str(config.max_views),
            todo="ask for more --max-views, or for fewer --views",
        )
    if config.seconds is not None:
        return config
    return config.model_copy(update={"steps": steps, "max_views": None})


def select(config: RunConfig, scene: Scene, reader: str) -> tuple[Selection, list[str]]:
    """The components, loaded and fitted to the scene, and notes on what was chosen or left out.

    Raises:
        UserError: A name or option is wrong.
    """
    start_choice = _or_default(config.start, _usual_start(config))
    start = _built(Start, start_choice)
    _require_points(config, scene, start)
    _require_shown_points(config, scene, start)
    device = choose_device(config.device)
    notes: list[str] = list(scene.notes)
    sampler = _built(Sampler, config.sampler)
    operator, operator_name = operator_of(config)
    backbone = _built(Backbone, config.backbone)
    fitting = backbone.fitted_to(scene)
    backbone, left_out = pair(fitting, Backbone, tuple, backbone, "fitted_to")
    notes += left_out
    densifier_choice = _or_default(config.densifier, backbone.default_densifier)
    densifier = _built(Densifier, densifier_choice)
    wanted = Wanted(
        device=device.type,
        response=backbone.response,
        outputs=densifier.needs,
        options=frozenset({"footprint"} if config.preset == "inria" else ()),
    )
    rasterizer_name, choosing = choose_rasterizer(config.rasterizer.name, wanted)
    notes += choosing
    options = _rasterizer_options(config, scene, rasterizer_name)
    rasterizer = build(Rasterizer, rasterizer_name, options)
    views = config.view_plan or ViewPlan((usual_views(config, sampler, operator, notes),))
    usual = usual_resolution(config, views, backbone, densifier, device.type)
    resolution_choice = _or_default(config.resolution, usual)
    grouping_choice = _grouping_choice(config, sampler, operator, notes)
    exposure = _built(Exposure, config.exposure)
    fitted = answered(exposure.fitted_to(scene), Fitted, exposure, "fitted_to")
    notes += fitted.notes
    names = {
        "backbone": config.backbone.name,
        "sampler": config.sampler.name,
        "operator": operator_name,
        "densifier": densifier_choice.name,
        "rasterizer": rasterizer_name,
        "loss": config.loss.name,
        "exposure": fitted.name or config.exposure.name,
        "start": start_choice.name,
        "resolution": resolution_choice.name,
        "exporter": config.exporter.name,
        "reader": reader,
    }
    grouping = None
    if grouping_choice is not None:
        grouping = _built(Grouping, grouping_choice)
        names["grouping"] = grouping_choice.name
    selection = Selection(
        backbone=backbone,
        sampler=sampler,
        operator=operator,
        densifier=densifier,
        rasterizer=rasterizer,
        loss=_built(Loss, config.loss),
        exposure=fitted.exposure,
        start=start,
        resolution=_built(Resolution, resolution_choice).fitted_to(scene),
        exporter=_built(Exporter, config.exporter),
        metrics=_metrics(config, scene, notes),
        names=names,
        views_per_step=max(views.counts),
        device=device.type,
        grouping=grouping,
        view_plan=views,
    )
    return selection, notes


def _usual_start(config: RunConfig) -> str:
    """The start of a run that names none."""
    bare = config.preset == "inria" or config.reading.init != "points"
    return BARE_START if bare else START


def _require_points(config: RunConfig, scene: Scene, start: Start) -> None:
    if not len(scene.points) and config.reading.init == "points" and not start.alone:
        raise UserError(
            "the scene has no SfM points to start from",
            where=config.scene or scene.name,
            todo=f"find some in the photos (--start {START_ALONE}), or start from random ones "
            "(--init random) or from those of a file (--init FILE.ply)",
        )


def _require_shown_points(config: RunConfig, scene: Scene, start: Start) -> None:
    if not len(scene.points) or config.reading.init != "points" or start.alone:
        return
    if not any(is_in_image(view.camera, scene.points).any() for view in scene.train_views):
        raise UserError(
            "no training photo shows any of the scene's points: there is nothing to train",
            where=config.scene or scene.name,
            expected="points and cameras in one frame, with the cameras looking at the points",
            found=f"{len(scene.points):,} points, none of them in {len(scene.train_views)} photos",
            todo=f"mend the model, or find points in the photos (--start {START_ALONE})",
        )


def _built(slot: type[C], choice: ComponentChoice) -> C:
    return build(slot, choice.name, choice.options)


def _metrics(config: RunConfig, scene: Scene, notes: list[str]) -> dict[str, Metric]:
    """The metrics by name; of those by default only what gives each column a name of its own.

    Raises:
        UserError: Two columns of metrics.csv would have one name.
    """
    metrics: dict[str, Metric] = {}
    regimes = sorted({view.regime for view in scene.test_views})
    for name, choice in {each.name: each for each in config.metrics}.items():
        metric = _built(Metric, choice)
        columns = columns_for(regimes, [each.figure for each in (*metrics.values(), metric)])
        twice = sorted({each for each in columns if columns.count(each) > 1})
        if not twice:
            metrics[name] = metric
        elif name in METRICS.split("+"):
            notes.append(f"metric {name} is left out: metrics.csv has a column {listed(twice)}")
        else:
            raise UserError(
                f"two columns of metrics.csv would be called {listed(twice)}",
                where=f"metrics {listed((*metrics, name))}; regimes {listed(regimes)}",
                expected="figures whose names are no other's, nor those of another one in a regime",
                todo=f"leave metric {name} out, or rename the folder of photos",
            )
    return metrics


def _or_default(choice: ComponentChoice | None, name: str) -> ComponentChoice:
    """The choice, where its name is left open with the default one."""
    if choice is None:
        return ComponentChoice(name=name)
    return choice.model_copy(update={"name": name}) if choice.name == AUTO else choice


def _rasterizer_options(config: RunConfig, scene: Scene, name: str) -> dict[str, Any]:
    options = dict(config.rasterizer.options)
    if config.preset == "inria":
        if "footprint" not in load("rasterizers", name).model_fields:
            raise UserError(
                f"rasterizer {name} does not have the footprint of the original code",
                where="--preset inria",
                expected="a rasterizer with the option footprint",
                todo="leave --rasterizer out: auto takes one that has it; or leave the preset out",
            )
        options.setdefault("footprint", "3-sigma")
        # The published near plane is 0.2 units of the input frame.
        options.setdefault("near", 0.2 * scene.similarity.scale)
    return options


def _grouping_choice(
    config: RunConfig, sampler: Sampler, operator: Operator, notes: list[str]
) -> ComponentChoice | None:
    if config.grouping is not None and config.grouping.name != AUTO:
        return config.grouping
    # Labels that the sampler makes up leave a grouping nothing to do.
    of_operator = None if sampler.own_labels else operator.usual_grouping
    name = sampler.default_grouping or of_operator
    if name is not None:
        return _or_default(config.grouping, name)
    if config.grouping is not None:
        raise UserError(
            "neither the sampler nor the operator uses a grouping that could have options",
            where="grouping",
            todo="name the grouping with --grouping, or leave its options out",
        )
    notes.append(f"no grouping: sampler {config.sampler.name} draws from all views alike")
    return None


def _groups(
    config: RunConfig, scene: Scene, selection: Selection, notes: list[str]
) -> tuple[str, ...] | None:
    grouping = selection.grouping
    if grouping is None:
        return None
    rng = make_streams(config.seed)["grouping"]
    rule = grouping.fit(scene, rng)
    labels = labels_of(rule, scene, selection.names["grouping"])
    notes += rule.notes
    notes += mode_note(selection.names["grouping"], grouping, scene)
    counts = {label: labels.count(label) for label in dict.fromkeys(labels)}
    counted = listed(f"{label} {count}" for label, count in counts.items())
    notes.append(f"groups of training views: {counted}")
    return labels


def _plugins(selection: Selection, observers: Mapping[str, Component]) -> dict[str, object]:
    plugins: dict[str, object] = {**selection.components}
    for name, metric in selection.metrics.items():
        plugins[f"metric:{name}"] = metric
    for name, observer in observers.items():
        plugins[f"observer:{name}"] = observer
    return plugins


def reasons_against(
    config: RunConfig, selection: Selection, answers: Iterable[list[str]]
) -> tuple[str, ...]:
    """Why the selection cannot work: what its components object, and what the core does."""
    given = [[answer] if isinstance(answer, str) else answer for answer in answers]
    reasons = objections_to(selection) + [reason for answer in given for reason in answer]
    if config.backward == "joint" and selection.operator.separate:
        reasons.append(
            f"--backward joint makes one gradient of all views, but operator "
            f"{selection.names['operator']} needs them apart"
        )
    views = selection.views_per_step
    if config.batch_rule == "sqrt" and views > MOST_VIEWS:
        reasons.append(f"--batch-rule sqrt has a meaning for K <= {MOST_VIEWS}; K is {views}")
    return tuple(sorted(set(reasons)))


def refuse(reasons: tuple[str, ...]) -> None:
    """Ends the start of a run for these reasons, if there are any.

    Raises:
        IncompatibleSelectionError: There are.
    """
    if reasons:
        raise IncompatibleSelectionError(
            "these components cannot work together",
            found="; ".join(reasons),
            todo="choose another combination (crossgrad plugins show NAME tells what each needs)",
        )


def _linear_note(setup: Setup) -> tuple[str, ...]:
    name = setup.selection.names["operator"]
    if setup.operator.separate:
        return ()
    if setup.watchers:
        return (
            f"gradients of single views kept apart for {', '.join(setup.watchers)} (same bits)",
        )
    return (f"no separate gradients: operator {name} is linear, the backward passes accumulate",)

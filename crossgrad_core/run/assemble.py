"""Build the `Setup` of a run: read the scene, select the components and check them."""

import logging
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path

from crossgrad_core.config import AUTO, ComponentChoice, RunConfig
from crossgrad_core.contract.blocks import MOST_VIEWS
from crossgrad_core.contract.component import Component
from crossgrad_core.contract.objections import objections_to
from crossgrad_core.contract.scene import Scene
from crossgrad_core.contract.schedule import Counting, ViewsPerStepSpec
from crossgrad_core.contract.selection import Selection
from crossgrad_core.contract.slots.observer import Observer
from crossgrad_core.contract.slots.reader import Reader
from crossgrad_core.defaults import READER
from crossgrad_core.errors import IncompatibleSelectionError, UserError
from crossgrad_core.recipe.table import is_complete
from crossgrad_core.registry.entries import (
    build,
    entries,
    find,
    from_elsewhere,
    quick_answer,
    refuse_other_version,
)
from crossgrad_core.registry.file_formats import exporter_for
from crossgrad_core.registry.manager import make_manager
from crossgrad_core.registry.slots import GROUPS, LISTS, MANY
from crossgrad_core.run.decisions import DEFAULT_STEPS, with_decisions
from crossgrad_core.run.devices import choose_device, with_device
from crossgrad_core.run.export import check_frame
from crossgrad_core.run.select import select
from crossgrad_core.scene.self_check.check import checked
from crossgrad_core.training.modes import mode_note
from crossgrad_core.training.rngs import make_streams
from crossgrad_core.training.scaled_photos import DevicePhotos, ScaledPhotos
from crossgrad_core.training.schedules import notes_on_length, schedule_of
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.step import labels_of
from crossgrad_core.wording import in_one_line, listed, plural, singular


def idle_note(setup: Setup) -> tuple[str, ...]:
    """Return a note if the operator leaves the gradient of a single view unchanged.

    The note also suggests a remedy. There is no note for the default operator, because users expect
    that the sum of one gradient is this gradient.
    """
    selection = setup.selection
    name, views = selection.names["operator"], selection.views_per_step
    default: ComponentChoice = RunConfig.model_fields["operator"].default
    if name == default.name or not selection.operator.is_identity(views):
        return ()
    sampler = selection.names["sampler"]
    more = next((k for k in (2, 3) if selection.sampler.view_counts.admits(k)), None)
    way_out = (
        f"--views {more}" if more else f"another sampler than {sampler} with its present options"
    )
    return (
        (
            f"operator {name} has no effect at K = {views}, because a step has only one "
            f"gradient; {way_out} gives it more views"
        ),
    )


_LOG = logging.getLogger(__name__)


def read_scene(config: RunConfig, path: Path) -> tuple[Scene, str]:
    """Return the scene and the name of the reader that read it.

    Raises:
        UserError: No reader accepts the folder, several readers accept it, or the reader fails.
    """
    _LOG.info("reading scene %s", path)
    name = config.reader.name
    if name == AUTO:
        able = [reader for reader in entries("readers") if accepts(reader, path)]
        if len(able) > 1:
            raise UserError(
                "the scene folder contains files of several formats",
                where=path,
                found=f"files for the readers {listed(able)}",
                todo=f"choose a reader, such as --reader {able[0]}",
            )
        # If no reader accepts the folder, use one reader whose error message explains what is
        # missing.
        near = (
            []
            if able
            else [reader for reader in entries("readers") if nearly_accepts(reader, path)]
        )
        name = (*able, *near, READER)[0]
    return build(Reader, name, config.reader.options).read(path, config.data), name


def read_and_check(config: RunConfig, path: Path, *, accept: bool = False) -> tuple[Scene, str]:
    """Read a scene like `read_scene`, and check points, poses and photos against each other.

    Args:
        config: The configuration.
        path: The scene's folder.
        accept: True to continue although points, poses and photos do not match. The setting
            `data.accept_scene` has the same effect.

    Raises:
        UserError: Points, poses and photos do not match; see also `read_scene`.
    """
    scene, name = read_scene(config, path)
    data = config.data
    accept = accept or data.accept_scene
    return checked(scene, path, cache_mib=data.cache_mib, accept=accept), name


def accepts(name: str, path: Path) -> bool:
    """Return True if a reader accepts the folder; False, with a warning, if the reader fails."""
    return _answer(name, lambda: _accepts(name, path))


def nearly_accepts(name: str, path: Path) -> bool:
    """Return True if a file in the folder has almost the format of a reader (see `accepts`)."""
    return _answer(name, lambda: build(Reader, name, {}).nearly_accepts(path))


def _accepts(name: str, path: Path) -> bool:
    quick = quick_answer(find("readers", name))
    return bool(build(Reader, name, {}).accepts(path) if quick is None else quick(path))


def _answer(name: str, question: Callable[[], bool]) -> bool:
    try:
        return question()
    except Exception as error:
        _LOG.warning(
            "reader %s cannot be used: %s", name, getattr(error, "what", in_one_line(error))
        )
        return False


def check_names(config: RunConfig) -> None:
    """Look up every component and the device before a large scene is read.

    Raises:
        UserError: A name does not exist, or the package of a component requires another version of
            crossgrad.
    """
    if config.device != AUTO:
        choose_device(config.device)
    named = [("operators", link) for link in config.operators]
    named += [(slot, choice) for slot in LISTS for choice in getattr(config, slot)]
    named += [("rules", ComponentChoice(name=name)) for name in config.rules]
    single = (slot for slot in GROUPS if slot not in {"operators", *MANY})
    named += [(slot, getattr(config, singular(slot))) for slot in single]
    for slot, choice in named:
        unread = slot == "recipes" and is_complete(config)
        if choice is not None and choice.name != AUTO and not unread:
            refuse_other_version(find(slot, choice.name))


def assemble(config: RunConfig, scene: Scene, reader: str) -> Setup:
    """Load all components of a configuration, fit them to the scene and check them.

    Args:
        config: The configuration.
        scene: The scene of the run.
        reader: Name of the reader that read the scene.

    Raises:
        UserError: A name or option is wrong, or the components cannot work together.
    """
    config, of_device = with_device(config)
    for note in of_device:
        _LOG.info("%s", note)
    scene = replace(scene, notes=(*of_device, *scene.notes))
    config, decisions, decide = with_decisions(_with_first_degree(config), scene)
    selection, notes = select(config, scene, reader)
    observers = {
        choice.name: build(Observer, choice.name, choice.options) for choice in config.observers
    }
    plugins = _plugins(selection, observers)
    manager = make_manager(plugins)
    answers = manager.hook.crossgrad_validate_selection(selection=selection)
    refuse(reasons_against(config, selection, answers))
    groups = _groups(config, scene, selection, notes)
    config = _with_steps(config, selection.views)
    photos = len(scene.train_views)
    counting = Counting(
        views=selection.views, photos=photos, schedule_length=config.schedule_length
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
        decisions=decisions,
        decide=decide,
    )
    # The length of a run with a time budget is planned later, so leave out the notes on the length.
    timed = notes_on_length(setup) if config.seconds is None else ()
    named = {plural(word): [name] for word, name in selection.names.items()}
    named["operators"] = [operator.name for operator in config.operators]
    named |= {"metrics": [*selection.metrics], "observers": [*observers]}
    added = (
        *from_elsewhere({**named, "rules": [*selection.rules]}),
        *_linear_note(setup),
        *idle_note(setup),
        *timed,
    )
    return replace(setup, notes=(*setup.notes, *added))


def _photos(config: RunConfig) -> ScaledPhotos | DevicePhotos:
    """Return the cache of reduced photos, and on a GPU also the cache of photos in GPU memory."""
    mib, device = config.data.cache_mib, choose_device(config.device)
    # Use a quarter of the limit, because photos of half the side length use a quarter of the
    # memory.
    scaled = ScaledPhotos(mib // 4)
    return scaled if device.type == "cpu" else DevicePhotos(scaled, device, mib)


def _with_first_degree(config: RunConfig) -> RunConfig:
    """Return the configuration with the SH degree at which the run starts.

    The degree is stored, so that a resumed run does not need the PLY file of `--init`.
    """
    path = config.data.init_file
    if config.sh_from is not None or path is None:
        return config
    exporter = exporter_for(path, "--init")
    check_frame(path)
    degree = exporter.sh_degree_of(path)
    return config.model_copy(update={"sh_from": degree})


def _with_steps(config: RunConfig, views: ViewsPerStepSpec) -> RunConfig:
    """Return the configuration with a length in steps, unless its length is in seconds.

    If a length in seconds and a limit in views are set, the limit is kept. The first steps of the
    run show whether the time is sufficient for all views.

    Raises:
        UserError: A single step renders more views than `max_views`.
    """
    if config.max_views is None:
        has_length = config.seconds is not None or config.steps is not None
        return config if has_length else config.model_copy(update={"steps": DEFAULT_STEPS})
    steps = views.steps_of(config.max_views)
    if steps == 0:
        raise UserError(
            "--max-views is smaller than the number of views of the first step",
            where="--max-views",
            expected=f"at least {views.counts[0]}, the number of views of the first step",
            found=str(config.max_views),
            todo="raise --max-views, or lower --views",
        )
    if config.seconds is not None:
        return config
    return config.model_copy(update={"steps": steps, "max_views": None})


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
    plugins = selection.plugins
    for name, metric in selection.metrics.items():
        plugins[f"metric:{name}"] = metric
    for name, observer in observers.items():
        plugins[f"observer:{name}"] = observer
    return plugins


def reasons_against(
    config: RunConfig, selection: Selection, answers: Iterable[list[str]]
) -> tuple[str, ...]:
    """Return the objections of the components and of the core to the selected components."""
    given = [[answer] if isinstance(answer, str) else answer for answer in answers]
    reasons = objections_to(selection) + [reason for answer in given for reason in answer]
    if config.backward == "joint" and selection.operator.separate:
        reasons.append(
            "--backward joint computes only the sum of the views' gradients, but "
            f"operator {selection.names['operator']} needs the gradient of each view"
        )
    views = selection.views_per_step
    if config.batch_rule == "sqrt" and views > MOST_VIEWS:
        reasons.append(f"--batch-rule sqrt supports at most K = {MOST_VIEWS} views; K is {views}")
    return tuple(sorted(set(reasons)))


def refuse(reasons: tuple[str, ...]) -> None:
    """Raise an error if there are reasons against the selected components.

    Raises:
        IncompatibleSelectionError: `reasons` is not empty.
    """
    if reasons:
        raise IncompatibleSelectionError(
            "the selected components cannot work together",
            found="; ".join(reasons),
            todo="choose another combination (`crossgrad plugins show NAME` lists the "
            "requirements of a component)",
        )


def _linear_note(setup: Setup) -> tuple[str, ...]:
    name = setup.selection.names["operator"]
    if setup.operator.separate:
        return ()
    if setup.watchers:
        return (
            (
                f"gradients of single views are stored for {', '.join(setup.watchers)} (the "
                f"training result is bitwise equal)"
            ),
        )
    return (
        (
            f"gradients of single views are not stored: operator {name} is linear, so the "
            "backward passes accumulate their sum"
        ),
    )

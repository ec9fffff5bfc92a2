"""Functions that assemble a run from settings, or load a run from its folder."""

import logging
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any, Final, cast

from crossgrad_core import defaults
from crossgrad_core.config import CHANGEABLE, ComponentChoice, RunConfig
from crossgrad_core.contract.blocks import AdamState, Json
from crossgrad_core.contract.contexts import StepRecord
from crossgrad_core.defaults import PROGRESS
from crossgrad_core.errors import UserError
from crossgrad_core.numerics.threads import configure_threads
from crossgrad_core.registry.entries import build, entries
from crossgrad_core.registry.slots import LISTS, MANY
from crossgrad_core.run.assemble import assemble, check_names, read_and_check, read_scene
from crossgrad_core.run.checkpoint import (
    CHECKPOINTS,
    Checkpoint,
    load_latest,
    named_checkpoints,
)
from crossgrad_core.run.devices import with_device
from crossgrad_core.run.rasterizers import drawn_elsewhere
from crossgrad_core.run.results.config_file import FILE as CONFIG
from crossgrad_core.run.results.config_file import read_config, read_notes
from crossgrad_core.run.results.kept import edited, restored
from crossgrad_core.run.results.lock import writer_of
from crossgrad_core.run.results.plugins_file import (
    Packages,
    history,
    packages_of,
    read_plugins,
    refuse_changed,
    refuse_missing,
    report_changed,
    with_present,
    without_outdated,
)
from crossgrad_core.run.results.scene_file import check_scene
from crossgrad_core.run.results.summary import Status, summarised_step
from crossgrad_core.run.settings import parsed
from crossgrad_core.scene.fingerprint import Fingerprint, Weight, fingerprint_of
from crossgrad_core.system.version import VERSION
from crossgrad_core.training.budget import replay_length
from crossgrad_core.training.per_image_params import check_photos_are
from crossgrad_core.training.rngs import restored_streams, stream_states
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.start import first_state
from crossgrad_core.training.state import Clock, Counters, TrainState
from crossgrad_core.wording import in_one_line, listed, plural, singular

#: Settings that do not affect the trained result, or that a resumed run may have changed. Examples
#: are paths, the times of evaluations, and the length of a run with a time budget.
_LOOSE: Final = frozenset(
    {
        "clock",
        "device",
        "eval_every",
        "decided",
        "eval_from",
        "exporter",
        "exposure_from",
        "max_nonfinite_blocks",
        "max_views",
        "metrics",
        "observers",
        "out",
        "plan",
        "planned_seconds",
        "planned_views",
        "data",
        "revised",
        "revisions",
        "save_every",
        "scene",
        "seconds",
        "stop_after",
        "threads",
    }
)
#: Slot whose component may differ on another machine.
_DRAWN: Final = "rasterizer"
#: Key that records whether the length follows a time budget.
_TIMED: Final = "time budget"


def settings_of(config: RunConfig) -> dict[str, Json]:
    """Return the version and the settings that affect training, such as `loss.ssim_weight`."""
    loose = set(_LOOSE)
    if config.planned_seconds is None:
        loose -= {"revisions"}
    else:
        loose |= {"steps"}  # The run may have changed the number of steps to meet its time budget.
    data = config.model_dump(mode="json", exclude=loose)
    # Ignore the rasterizer, because another machine may use another rasterizer, but compare its
    # options.
    del data[_DRAWN]["name"]
    # Use the default of `_config` if the configuration of the run does not contain this setting.
    data |= {
        "sh_from": config.sh_from or 0,
    }
    flat: dict[str, Json] = {"crossgrad": VERSION}
    for key, value in data.items():
        inner = value.items() if isinstance(value, dict) else ()
        flat |= {f"{key}.{name}": option for name, option in inner} or {key: value}
    return {**flat, _TIMED: config.planned_seconds is not None}


def to_checkpoint(state: TrainState, config: RunConfig | None = None) -> Checkpoint:
    """Return the state as a checkpoint; tensors are shared, not copied.

    Args:
        state: The state.
        config: The configuration that trained the state; None if a later load need not compare
            settings.
    """
    scalars: dict[str, Any] = {
        "settings": {} if config is None else settings_of(config),
        "clock": asdict(state.clock),
        "counters": asdict(state.counters),
        "rewinds": state.rewinds,
        "last": None if state.last is None else asdict(state.last),
    }
    return Checkpoint(
        step=state.step,
        parameters={name: tensor.detach() for name, tensor in state.parameters.items()},
        exp_avg=state.adam.exp_avg,
        exp_avg_sq=state.adam.exp_avg_sq,
        adam_steps=state.adam.steps,
        plugins=state.states,
        generators=stream_states(state.rngs),
        scalars=cast("dict[str, Json]", scalars),
    )


def from_checkpoint(setup: Setup, checkpoint: Checkpoint) -> TrainState:
    """Return the state of a checkpoint, from which training continues with bitwise equal results.

    Raises:
        UserError: The checkpoint belongs to a run with another backbone or other photos, or the
            checkpoint is damaged.
    """
    _check_tensors(setup, checkpoint)
    try:
        state = _restored(setup, checkpoint)
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
        raise _misfit(checkpoint, "the state of a run", in_one_line(error)) from error
    check_photos_are(setup, state)
    rows = state.primitives(setup)
    for name, held in state.states.items():
        if any(tensor.shape[:1] != (rows,) for tensor in held.per_primitive.values()):
            raise _misfit(
                checkpoint, f"one row for each of {rows} Gaussians", f"the state of {name}"
            )
    return state


def check_settings(config: RunConfig, checkpoint: Checkpoint) -> None:
    """Refuse a state that was trained with other settings than `config`.

    Raises:
        UserError: Settings that affect training differ from the settings in the checkpoint.
    """
    stored = checkpoint.scalars.get("settings")
    if not isinstance(stored, dict) or stored.get("crossgrad") != VERSION:
        # Another version of crossgrad wrote the checkpoint. That version stored no settings, or it
        # used other names for its settings.
        return
    ours = settings_of(config)
    # Ignore settings that did not exist when the checkpoint was written. Compare new options of an
    # existing component, because they may change the training.
    known_components = {key.partition(".")[0] for key in stored}
    both = {key for key in ours.keys() | stored.keys() if key.partition(".")[0] in known_components}
    # Ignore options of the rasterizer and settings of the length that only the configuration or
    # only the checkpoint contains. Another rasterizer has other options. A run with a time budget
    # does not store the settings of the length.
    either = {_DRAWN, "steps", "revisions", "revised"}
    both -= {k for k in ours.keys() ^ stored.keys() if k.partition(".")[0] in either}
    changed = sorted(key for key in both if ours.get(key) != stored.get(key))
    if changed:
        raise UserError(
            "settings in config.yaml have changed since the run was started",
            where=f"settings {listed(changed)}; step {checkpoint.step}",
            expected=listed(f"{key}: {stored.get(key)}" for key in changed),
            found=listed(f"{key}: {ours.get(key)}" for key in changed),
            todo="restore the old values, or start a new run with the changed file (--config)",
        )


def _restored(setup: Setup, checkpoint: Checkpoint) -> TrainState:
    scalars = cast("dict[str, Any]", checkpoint.scalars)
    trained = {name for block in setup.trained_blocks for name in block.tensors}
    device = setup.device
    return TrainState(
        tensors={
            name: tensor.to(device).requires_grad_(name in trained)
            for name, tensor in checkpoint.parameters.items()
        },
        moments=AdamState(
            exp_avg={name: tensor.to(device) for name, tensor in checkpoint.exp_avg.items()},
            exp_avg_sq={name: tensor.to(device) for name, tensor in checkpoint.exp_avg_sq.items()},
            steps=dict(checkpoint.adam_steps),
        ),
        rngs=restored_streams(checkpoint.generators),
        states={name: state.to(device) for name, state in checkpoint.plugins.items()},
        step=checkpoint.step,
        last=_record(scalars["last"]),
        counters=Counters(**_figures(scalars["counters"])),
        clock=_clock(scalars["clock"]),
        rewinds=scalars["rewinds"],
    )


def _clock(plain: dict[str, Any]) -> Clock:
    phases = _figures(plain["phases"])
    rest = {name: value for name, value in plain.items() if name != "phases"}
    return Clock(**_figures(rest), phases=phases)


def _figures(plain: dict[str, Any]) -> dict[str, Any]:
    wrong = [name for name, value in plain.items() if not isinstance(value, int | float)]
    if wrong:
        raise TypeError(f"{listed(wrong)} is not a number")
    return plain


def _check_tensors(setup: Setup, checkpoint: Checkpoint) -> None:
    parameters = checkpoint.parameters
    wanted = [name for block in setup.blocks for name in block.tensors]
    missing = [name for name in wanted if name not in parameters]
    if missing:
        raise _misfit(checkpoint, f"parameters {listed(wanted)}", f"no {listed(missing)}")
    # Check trained parameters only, because frozen parameters may be whole numbers, such as the
    # levels of an octree.
    trained = [name for block in setup.trained_blocks for name in block.tensors]
    whole = [name for name in trained if not parameters[name].is_floating_point()]
    if whole:
        raise _misfit(checkpoint, "floating-point numbers for the trained tensors", listed(whole))
    rows = {
        parameters[name].shape[:1]
        for block in setup.blocks
        if block.per_primitive
        for name in block.tensors
    }
    if len(rows) > 1:
        raise _misfit(checkpoint, "the same number of rows in every parameter", str(sorted(rows)))
    for moments in (checkpoint.exp_avg, checkpoint.exp_avg_sq):
        for name, tensor in moments.items():
            if name not in parameters or tensor.shape != parameters[name].shape:
                raise _misfit(checkpoint, "moments with the shapes of the parameters", name)


def _misfit(checkpoint: Checkpoint, expected: str, found: str) -> UserError:
    return UserError(
        "the checkpoint does not match the run",
        where=f"the checkpoint of step {checkpoint.step}",
        expected=expected,
        found=found,
        todo="restore the config.yaml that the run wrote, continue from an earlier checkpoint, or "
        "start the run again",
    )


def _record(plain: dict[str, Any] | None) -> StepRecord | None:
    if plain is None:
        return None
    labels = plain["labels"]
    return StepRecord(
        **{
            **plain,
            "views": tuple(plain["views"]),
            "names": tuple(plain["names"]),
            "labels": None if labels is None else tuple(labels),
            "losses": tuple(plain["losses"]),
            "scales": tuple(plain.get("scales", ())),
        }
    )


_LOG = logging.getLogger(__name__)
#: Slot -> default component that replaces a missing component.
_PLAIN: Final = {
    "sampler": defaults.SAMPLER,
    "operator": defaults.OPERATOR,
    "densifier": defaults.NO_DENSIFIER,
    "loss": defaults.LOSS,
    # Use an initializer that needs no points, because the scene may contain no points.
    "initializer": defaults.INITIALIZER_WITHOUT_POINTS,
    "resolution": defaults.RESOLUTION,
}
#: Slots (singular words) whose components are not needed to evaluate a run.
REPLACEABLE: Final = frozenset({*_PLAIN, *map(singular, MANY)})


def without_missing(config: RunConfig) -> RunConfig:
    """Return the configuration with default components in place of missing training components.

    Metrics, observers and rules that are not installed are left out.
    """
    update: dict[str, object] = {}
    lacking = []
    for slot, plain in _PLAIN.items():
        chosen = config.operators if slot == "operator" else (getattr(config, slot),)
        if gone := [
            choice.name for choice in chosen if choice is not None and _is_gone(slot, choice)
        ]:
            lacking.append(f"{slot} {listed(gone)}")
            update[slot] = ComponentChoice(name=plain)
    for slot in LISTS:
        installed, chosen = entries(slot), getattr(config, slot)
        if gone := [choice.name for choice in chosen if choice.name not in installed]:
            lacking.append(f"{slot} {listed(gone)}")
            update[slot] = tuple(choice for choice in chosen if choice.name in installed)
    if gone := sorted(config.rules.keys() - entries("rules").keys()):
        lacking.append(f"rules {listed(gone)}")
        update["rules"] = {n: options for n, options in config.rules.items() if n not in gone}
    if lacking:
        _LOG.warning("components that are not installed here are not used: %s", listed(lacking))
    return config.model_copy(update=update)


def _is_gone(slot: str, choice: ComponentChoice) -> bool:
    """Return True if a component, or a component that its options name, is not installed."""
    if choice.name not in entries(plural(slot)):
        return True
    if slot != "operator":
        return False
    try:
        build(plural(slot), choice.name, choice.options)
    except UserError:
        return True
    return False


def as_it_was(config: RunConfig, trained: RunConfig) -> RunConfig:
    """Return the configuration with the components and rules that trained the run."""
    slots = (*_PLAIN, "rules")
    return config.model_copy(update={slot: getattr(trained, slot) for slot in slots})


#: Status of a run that wrote its results and a checkpoint.
_WITH_RESULTS: Final[tuple[Status, ...]] = ("finished", "stopped")
#: Note of a run that starts again, because it has no checkpoint.
BEGINS_AGAIN = "no checkpoint yet: the run starts again from its configuration"


def set_up(
    config: RunConfig,
    verbosity: int,
    check: Callable[[Fingerprint], tuple[str, ...]] | None = None,
    *,
    looks: bool = False,
) -> tuple[Setup, float]:
    """Return the assembled run, and the time for reading the scene and assembling, in seconds.

    Args:
        config: The configuration, with a scene.
        verbosity: -1 quiet, 0 normal, 1 verbose.
        check: Refuses a scene that is not the run's scene; returns notes about an accepted scene.
        looks: True if nothing will be trained; the consistency check of the scene is then omitted.

    Raises:
        UserError: The scene cannot be read, or the components cannot work together.
    """
    check_names(config)
    configure_threads(config.threads)
    start = perf_counter()
    path = cast("Path", config.scene)
    # Accept inconsistent data in the scene of a resumed run, because the run accepted the scene at
    # its start.
    scene, reader = (
        read_scene(config, path)
        if looks
        else read_and_check(config, path, accept=check is not None)
    )
    notes = () if check is None else check(fingerprint_of(scene, path))
    scene = replace(scene, notes=(*notes, *scene.notes))
    level = {-1: "quiet", 0: "normal", 1: "verbose"}[verbosity]
    if not any(choice.name == PROGRESS for choice in config.observers):
        progress = ComponentChoice.model_validate({"name": PROGRESS, "level": level})
        config = config.model_copy(update={"observers": (*config.observers, progress)})
    setup = assemble(config, scene, reader)
    return setup, perf_counter() - start


def _refuse_lost_checkpoints(folder: Path) -> None:
    """Refuse to start a run again if it has results but no checkpoints.

    Raises:
        UserError: The run has results, which a restart would replace.
    """
    for status in _WITH_RESULTS:
        if step := summarised_step(folder, status):
            raise UserError(
                "the checkpoints of the run are missing",
                where=folder / CHECKPOINTS,
                expected=f"the checkpoint of step {step}, the step of the results in the folder",
                found="none",
                todo="nothing was changed; --init with the run's point_cloud.ply starts a new run "
                "from its Gaussians, and `crossgrad run --config FOLDER/config.yaml` repeats "
                "the run in a new folder",
            )


def require_checkpoint(folder: Path) -> None:
    """Refuse a folder without a checkpoint; nothing is written to the folder.

    Raises:
        UserError: The folder is not a run, or the run has no checkpoint.
    """
    read_config(folder)
    if not named_checkpoints(folder / CHECKPOINTS):
        _refuse_lost_checkpoints(folder)
        writer = writer_of(folder)
        raise UserError(
            "the run has no checkpoint yet",
            where=folder,
            found=writer or "a run that ended before its first checkpoint",
            todo="wait for the first checkpoint"
            if writer
            else f"start the run again: crossgrad run --resume {folder}",
        )


def opened(
    folder: Path, settings: Mapping[str, Any], *, accept_scene: bool = False
) -> tuple[Setup, TrainState]:
    """Load a finished, stopped or still training run and its newest state, without writing.

    Args:
        folder: The run's folder.
        settings: Only `device`, `threads` and `stop_after` may differ from the run's own settings.
        accept_scene: Accept a scene whose photos, masks, points or held-out views have changed.

    Raises:
        UserError: The folder is not a run, the run has no checkpoint, a setting would change the
            training, or the scene is not the run's scene.
    """
    require_checkpoint(folder)
    check = partial(check_scene, folder, tolerated=Weight.HELD_OUT, accept=accept_scene)
    packages = read_plugins(folder)
    refuse_missing(folder, packages, optional=REPLACEABLE)
    report_changed(packages)
    return _from(folder, {"threads": None, **settings}, -1, check, packages, looks=True)


def continued(
    folder: Path,
    settings: Mapping[str, Any],
    verbosity: int,
    *,
    accept_scene: bool = False,
    accept_plugins: bool = False,
) -> tuple[Setup, TrainState]:
    """Load a run's setup and the state from which the run continues.

    The state is the state of the newest checkpoint, or the initial state if there is no checkpoint.

    Args:
        folder: The run's folder.
        settings: Only `device`, `threads` and `stop_after` may differ from the run's own settings.
        verbosity: -1 quiet, 0 normal, 1 verbose.
        accept_scene: Accept a scene whose photos, masks or points have changed.
        accept_plugins: Accept other versions of the packages that train the run.

    Raises:
        UserError: The folder is not a run, a setting would change the training, or the scene or a
            package has changed.
    """
    check = partial(check_scene, folder, tolerated=Weight.CONTENT, accept=accept_scene)
    packages = read_plugins(folder)
    refuse_missing(folder, packages)
    if named_checkpoints(folder / CHECKPOINTS):
        if not accept_plugins:
            refuse_changed(folder, packages)
        return _from(folder, settings, verbosity, check, packages)
    _refuse_lost_checkpoints(folder)
    setup, seconds = set_up(_config(folder, settings), verbosity)
    state = first_state(setup)
    state.clock.load = seconds
    return replace(setup, notes=(BEGINS_AGAIN, *_noted(folder, setup, None))), state


def _from(
    folder: Path,
    settings: Mapping[str, Any],
    verbosity: int,
    check: Callable[[Fingerprint], tuple[str, ...]],
    packages: Packages | None,
    *,
    looks: bool = False,
) -> tuple[Setup, TrainState]:
    checkpoint = load_latest(folder)
    # Read the configuration after the checkpoint. A run with a time budget may add settings to the
    # file at any time, and older settings stay valid.
    config = _config(folder, settings)
    config_now = without_missing(config) if looks else config
    setup, seconds = set_up(config_now, verbosity, check, looks=looks)
    check_settings(as_it_was(setup.config, config), checkpoint)
    state = from_checkpoint(setup, checkpoint)
    state.clock.load += seconds
    packages = packages if looks else with_present(packages, packages_of(setup))
    notes = edited(folder, checkpoint.scalars)
    if looks:
        for note in notes:
            _LOG.warning("%s", note)
    else:
        notes = (*restored(folder, checkpoint.scalars, state.step), *notes)
    notes = (*notes, *_noted(folder, setup, packages))
    return replay_length(replace(setup, notes=notes), state.step), state


def _noted(folder: Path, setup: Setup, packages: Packages | None) -> tuple[str, ...]:
    """Return the scene's current notes, the notes of the run's start, and changes of packages."""
    packages = packages or {}
    stored = without_outdated(read_notes(folder) or setup.notes, packages)
    return tuple(dict.fromkeys((*setup.scene.notes, *stored, *history(packages))))


def _config(folder: Path, settings: Mapping[str, Any]) -> RunConfig:
    """Return the configuration in the run's folder, with changeable settings from `settings`."""
    frozen = sorted(set(settings) - CHANGEABLE)
    if frozen:
        raise UserError(
            "settings cannot be changed when a run is resumed",
            where=f"settings {listed(frozen)}",
            expected=f"only {listed(sorted(CHANGEABLE))}",
            todo="leave these settings out, or start a new run",
        )
    stored = read_config(folder)
    stored.pop("stop_after", None)
    # A missing SH degree means degree 0, because the first versions of crossgrad started with
    # degree 0.
    stored["sh_from"] = stored.get("sh_from") or 0
    try:
        config = parsed({**stored, **settings})
    except UserError as error:
        raise UserError(
            error.what,
            where=f"{folder / CONFIG}, {error.where}",
            expected=error.expected,
            found=error.found,
            todo=error.todo,
        ) from error
    if "device" in settings:
        return drawn_elsewhere(with_device(config)[0])
    _check_device(config.device, folder)
    return config


def _check_device(name: str, folder: Path) -> None:
    """Refuse a device that does not exist on this machine; the message suggests a remedy."""
    import torch

    if name.startswith("cuda") and not torch.cuda.is_available():
        raise UserError(
            "the run was trained on CUDA, and torch sees no CUDA device here",
            where=f"{folder / CONFIG}, device: {name}",
            todo="add --device cpu, or resume the run on a machine with a CUDA device",
        )

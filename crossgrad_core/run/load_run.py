"""From settings, or from a run's folder, to a run that can go on."""

import logging
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any, Final, cast

from pydantic import ValidationError

from crossgrad_core.config import ComponentChoice, RunConfig
from crossgrad_core.defaults import PROGRESS
from crossgrad_core.errors import UserError
from crossgrad_core.numerics.threads import configure_threads
from crossgrad_core.registry.validation import as_user_error
from crossgrad_core.run.assemble import assemble, check_names, read_and_check, read_scene
from crossgrad_core.run.changeable_settings import CHANGEABLE
from crossgrad_core.run.checkpoint.checkpoint import load_latest
from crossgrad_core.run.checkpoint.folders import CHECKPOINTS, named_checkpoints
from crossgrad_core.run.checkpoint_io import check_settings, from_checkpoint
from crossgrad_core.run.missing_plugins import REPLACEABLE, as_it_was, without_missing
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
from crossgrad_core.run.usual_device import with_device
from crossgrad_core.scene.differences import Weight
from crossgrad_core.scene.fingerprint import Fingerprint, fingerprint_of
from crossgrad_core.training.budget import replay_length
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.start import first_state
from crossgrad_core.training.state import TrainState
from crossgrad_core.wording import listed

_LOG = logging.getLogger(__name__)
#: How a run ended that wrote down its results, and a checkpoint with them.
_WITH_RESULTS: Final[tuple[Status, ...]] = ("finished", "stopped")
#: What a run says that has to begin again.
BEGINS_AGAIN = "no checkpoint yet: the run begins again from its configuration"


def parsed(settings: Mapping[str, Any]) -> RunConfig:
    """The validated configuration.

    Raises:
        UserError: A setting does not exist or has a wrong value.
    """
    try:
        return RunConfig.model_validate(settings)
    except ValidationError as error:
        raise as_user_error(
            error,
            RunConfig,
            subject="a run",
            todo="docs/settings.md lists every setting, crossgrad run --help-all every option",
        ) from error


def set_up(
    config: RunConfig,
    verbosity: int,
    check: Callable[[Fingerprint], tuple[str, ...]] | None = None,
    *,
    looks: bool = False,
) -> tuple[Setup, float]:
    """The assembled run and the seconds that reading the scene took.

    Args:
        config: The configuration, with a scene.
        verbosity: -1 quiet, 0 normal, 1 verbose.
        check: Refuses a scene that is not the run's; answers with notes on one that it takes.
        looks: Nothing will be trained: the scene is not checked against itself.

    Raises:
        UserError: The scene cannot be read, or the components cannot work together.
    """
    check_names(config)
    configure_threads(config.threads)
    start = perf_counter()
    path = cast("Path", config.scene)
    # A run that goes on began with this scene, so that it was accepted.
    scene, reader = (
        read_scene(config, path)
        if looks
        else read_and_check(config, path, accept=check is not None)
    )
    notes = () if check is None else check(fingerprint_of(scene, path))
    scene = replace(scene, notes=(*notes, *scene.notes))
    seconds = perf_counter() - start
    level = {-1: "quiet", 0: "normal", 1: "verbose"}[verbosity]
    if not any(choice.name == PROGRESS for choice in config.observers):
        progress = ComponentChoice.model_validate({"name": PROGRESS, "level": level})
        config = config.model_copy(update={"observers": (*config.observers, progress)})
    return assemble(config, scene, reader), seconds


def _refuse_lost_checkpoints(folder: Path) -> None:
    """Keeps the results of a run whose checkpoints somebody removed: it must not begin again here.

    Raises:
        UserError: The run has results, so that it had checkpoints.
    """
    for status in _WITH_RESULTS:
        if step := summarised_step(folder, status):
            raise UserError(
                "the checkpoints of the run are gone",
                where=folder / CHECKPOINTS,
                expected=f"step {step}, which the results in the folder are of",
                found="none",
                todo="its files are as they were, and --init with its point_cloud.ply starts from "
                "its Gaussians; `crossgrad run --config FOLDER/config.yaml` repeats it elsewhere",
            )


def require_checkpoint(folder: Path) -> None:
    """Refuses a folder in which there is nothing to look at yet; writes nothing there.

    Raises:
        UserError: It is no run, or it has no checkpoint.
    """
    read_config(folder)
    if not named_checkpoints(folder / CHECKPOINTS):
        _refuse_lost_checkpoints(folder)
        writer = writer_of(folder)
        raise UserError(
            "the run has no checkpoint yet",
            where=folder,
            found=writer or "a run that was ended before its first checkpoint",
            todo="wait for the first one"
            if writer
            else f"crossgrad run --resume {folder} begins it again",
        )


def opened(
    folder: Path, settings: Mapping[str, Any], *, accept_scene: bool = False
) -> tuple[Setup, TrainState]:
    """A finished or stopped run and its newest state, to look at; it may be training meanwhile.

    Args:
        folder: The run's folder.
        settings: Only `device`, `threads` and `stop_after` may differ from the run's own.
        accept_scene: Take a scene of which photos, masks, points or held-out views have changed.

    Raises:
        UserError: It is no run, it has no checkpoint, a setting would change the training, or the
            scene is another one.
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
    """A run's setup and the state that it goes on from.

    That is the newest one, or, where the run was ended before its first checkpoint, the first.

    Args:
        folder: The run's folder.
        settings: Only `device`, `threads` and `stop_after` may differ from the run's own.
        verbosity: -1 quiet, 0 normal, 1 verbose.
        accept_scene: Take a scene of which photos, masks or points have changed.
        accept_plugins: Take other versions of the packages that train the run.

    Raises:
        UserError: It is no run, a setting would change the training, or the scene or a package is
            another one.
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
    # Read after the checkpoint: a run that follows the clock only adds to its configuration.
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
    """What the scene says now, and what the run noted when it decided what is a setting now."""
    packages = packages or {}
    stored = without_outdated(read_notes(folder) or setup.notes, packages)
    return tuple(dict.fromkeys((*setup.scene.notes, *stored, *history(packages))))


def _config(folder: Path, settings: Mapping[str, Any]) -> RunConfig:
    """The run's own configuration with what may differ."""
    frozen = sorted(set(settings) - CHANGEABLE)
    if frozen:
        raise UserError(
            "a resumed run keeps its settings",
            where=f"settings {listed(frozen)}",
            expected=f"none but {listed(sorted(CHANGEABLE))}",
            todo="leave them out, or start a new run",
        )
    stored = read_config(folder)
    stored.pop("stop_after", None)
    # What a run began with is written down; where it is not, it was that of the first versions.
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
    """Says what to do where the run's own device is not on this machine."""
    import torch

    if name.startswith("cuda") and not torch.cuda.is_available():
        raise UserError(
            "the run was trained on CUDA, and torch sees no CUDA device here",
            where=f"{folder / CONFIG}, device: {name}",
            todo="add --device cpu, or go on where there is one",
        )

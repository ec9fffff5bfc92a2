"""The public API for commands of plugin packages: everything that a command imports.

The import of this module takes little time. Slow modules (torch, numba) are imported at the first
access to a name that needs them. A command can therefore report within two seconds that it has
started. Import this module at the top of a command's module, and call `announce()` first. Import
`crossgrad_core.plugin` (the types of scenes, models and components) only in modules that the
command imports later. The names in `__all__` keep their meaning within a minor version (see
docs/plugins.md).
"""

from collections.abc import Mapping
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from crossgrad_core.errors import UserError
from crossgrad_core.registry.commands import load_command, summary
from crossgrad_core.registry.entries import Entry, build, entries, load_entry, offers
from crossgrad_core.registry.entries import load as load_component
from crossgrad_core.registry.requirements import unmet_requirement
from crossgrad_core.registry.slots import (
    COMMANDS,
    GROUPS,
    MANY,
    OFFERED,
    OWN_COMMANDS,
    Stray,
    strays,
)
from crossgrad_core.run.results.lock import FILE as LOCK
from crossgrad_core.run.results.lock import locked, writer_of
from crossgrad_core.system.check_writable import check_file, check_folder, check_new
from crossgrad_core.system.checksums import (
    changed_files,
    check_unchanged,
    drop_checksums,
    write_checksums,
)
from crossgrad_core.system.command_options import GroupedCommand, argument, command_of, option
from crossgrad_core.system.files import clear_leftovers as clear_half_written
from crossgrad_core.system.files import (
    disk_errors,
    disk_full,
    is_leftover,
    text_bytes,
    write_atomically,
)
from crossgrad_core.system.interrupts import exit_code, resume_hint, signal_names, tell
from crossgrad_core.system.startup import Progress, announce, finish
from crossgrad_core.system.terminal import controls_of, is_live
from crossgrad_core.system.text_files import parse_number, read_rows, table_bytes, write_table
from crossgrad_core.system.version import VERSION
from crossgrad_core.wording import (
    count,
    did_you_mean,
    listed,
    one_line,
    plural,
    sentences,
    showable,
    singular,
    with_article,
)

if TYPE_CHECKING:
    from crossgrad_core.config import ComponentChoice, RunConfig
    from crossgrad_core.contract.scene import Scene
    from crossgrad_core.gradients.separate import DenseGradients as gathered  # noqa: N813
    from crossgrad_core.registry.file_formats import exporter_for
    from crossgrad_core.run.assemble import accepts, assemble
    from crossgrad_core.run.decisions import DEFAULT_STEPS, facts_of, table_of
    from crossgrad_core.run.export import check_frame
    from crossgrad_core.run.load_run import opened as open_run
    from crossgrad_core.run.rasterizers import Wanted as RasterizerDemands
    from crossgrad_core.run.rasterizers import choose_rasterizer
    from crossgrad_core.run.results.panels import error_map, panels_of, read_panel
    from crossgrad_core.run.results.reading import RunResults, find_runs
    from crossgrad_core.run.results.reading import read_run as read_results
    from crossgrad_core.run.select import views_per_step_of
    from crossgrad_core.run.settings import layered, merged
    from crossgrad_core.scene.shown_points import photos_per_point
    from crossgrad_core.system.yaml_values import read_mapping as read_settings
    from crossgrad_core.training.probe_gradients import view_gradients
    from crossgrad_core.training.setup import Setup
    from crossgrad_core.training.start import first_state as begin
    from crossgrad_core.training.state import NonFiniteError, TrainingFailedError, TrainState
    from crossgrad_core.training.step import evaluated_model, model_of

__all__ = [
    "COMMANDS",
    "DEFAULT_STEPS",
    "FAILED",
    "GROUPS",
    "LOCK",
    "MANY",
    "OFFERED",
    "OWN_COMMANDS",
    "VERSION",
    "ComponentChoice",
    "Entry",
    "GroupedCommand",
    "NonFiniteError",
    "Progress",
    "RasterizerDemands",
    "RunConfig",
    "RunResults",
    "Setup",
    "Stray",
    "TrainState",
    "TrainingFailedError",
    "UserError",
    "accepts",
    "affordable_steps",
    "announce",
    "argument",
    "assemble",
    "assemble_new",
    "available_cores",
    "available_memory",
    "begin",
    "build",
    "changed_files",
    "check_file",
    "check_folder",
    "check_frame",
    "check_new",
    "check_unchanged",
    "choose_rasterizer",
    "chosen",
    "clear_half_written",
    "command_of",
    "configured",
    "controls_of",
    "count",
    "did_you_mean",
    "disk_errors",
    "disk_full",
    "drop_checksums",
    "entries",
    "error_map",
    "evaluated_model",
    "exit_code",
    "exporter_for",
    "facts_of",
    "find_runs",
    "fingerprint",
    "finish",
    "gathered",
    "is_leftover",
    "is_live",
    "layered",
    "listed",
    "load_command",
    "load_component",
    "load_entry",
    "locked",
    "merged",
    "model_of",
    "names",
    "offers",
    "one_line",
    "open_run",
    "option",
    "panels_of",
    "parse_number",
    "photos_per_point",
    "plural",
    "read_panel",
    "read_results",
    "read_rows",
    "read_scene",
    "read_settings",
    "resolved",
    "resume_hint",
    "sentences",
    "showable",
    "signal_names",
    "singular",
    "strays",
    "summary",
    "summary_of",
    "table_bytes",
    "table_of",
    "take_steps",
    "tell",
    "text_bytes",
    "unmet_requirement",
    "view_gradients",
    "views_per_step_of",
    "with_article",
    "with_steps",
    "write_atomically",
    "write_checksums",
    "write_mapping",
    "write_settings",
    "write_table",
    "writer_of",
]

#: Exit code of a command whose training failed.
FAILED: Final = 1
#: Name that is imported at its first access -> its module. If the name in the module differs, the
#: value is `module:name`.
_LATE: Final = {
    "ComponentChoice": "config",
    "DEFAULT_STEPS": "run.decisions",
    "NonFiniteError": "training.state",
    "RasterizerDemands": "run.rasterizers:Wanted",
    "RunConfig": "config",
    "RunResults": "run.results.reading",
    "Setup": "training.setup",
    "TrainState": "training.state",
    "TrainingFailedError": "training.state",
    "accepts": "run.assemble",
    "assemble": "run.assemble",
    "begin": "training.start:first_state",
    "error_map": "run.results.panels",
    "choose_rasterizer": "run.rasterizers",
    "check_frame": "run.export",
    "evaluated_model": "training.step",
    "exporter_for": "registry.file_formats",
    "facts_of": "run.decisions",
    "find_runs": "run.results.reading",
    "gathered": "gradients.separate:DenseGradients",
    "layered": "run.settings",
    "merged": "run.settings",
    "model_of": "training.step",
    "open_run": "run.load_run:opened",
    "panels_of": "run.results.panels",
    "photos_per_point": "scene.shown_points",
    "read_panel": "run.results.panels",
    "read_results": "run.results.reading:read_run",
    "read_settings": "system.yaml_values:read_mapping",
    "table_of": "run.decisions",
    "view_gradients": "training.probe_gradients",
    "views_per_step_of": "run.select",
}


def __getattr__(name: str) -> object:
    """Return the class or function `name`; its module is imported first."""
    if name not in _LATE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, there = _LATE[name].partition(":")
    return getattr(import_module(f"crossgrad_core.{module}"), there or name)


def names(slot: str) -> list[str]:
    """Return the sorted names of all installed plugins of a slot such as `operators`.

    Raises:
        KeyError: The slot does not exist.
    """
    return list(entries(slot))


def write_settings(path: Path, settings: Mapping[str, Any]) -> None:
    """Write settings as a configuration file, for `crossgrad run --config`.

    Raises:
        UserError: The disk is full, or the folder is read-only.
    """
    from crossgrad_core.run.results.config_file import marked

    write_mapping(path, marked(settings))


def write_mapping(path: Path, content: Mapping[str, Any]) -> None:
    """Write a mapping as a YAML file that `read_settings` can read.

    Raises:
        UserError: The disk is full, or the folder is read-only.
    """
    from crossgrad_core.system.yaml_values import write_yaml

    write_atomically(path, text_bytes(write_yaml(content)))


def configured(settings: Mapping[str, Any]) -> "RunConfig":
    """Return the configuration that `crossgrad run` would use, including the default scene.

    Args:
        settings: Settings as in a configuration file. A component is a mapping such as `{"name":
            "cagrad"}`.

    Raises:
        UserError: A setting does not exist or has a wrong value.
    """
    from crossgrad_core.run.app import with_defaults
    from crossgrad_core.run.settings import parsed, with_recipe

    return with_defaults(parsed(with_recipe(settings)))


def chosen(config: "RunConfig") -> "list[tuple[str, ComponentChoice]]":
    """Return pairs of slot and component choice for the components that a configuration names.

    A chain of operators gives one pair for each operator in the chain.
    """
    from crossgrad_core.config import AUTO, ComponentChoice

    choices_by_slot: list[tuple[str, ComponentChoice]] = []
    for name in type(config).model_fields:
        value = getattr(config, name)
        choices = value if isinstance(value, tuple) else (value,)
        slot = name if name in MANY else plural(name)
        choices_by_slot += [(slot, item) for item in choices if isinstance(item, ComponentChoice)]
    choices_by_slot += [("rules", rule) for rule in config.used_rules]
    return [(slot, choice) for slot, choice in choices_by_slot if choice.name != AUTO]


def fingerprint(scene: "Scene", config: "RunConfig") -> str:
    """Return a digest that identifies a scene independently of its path.

    The digest covers cameras, split, points and files.

    Raises:
        UserError: A photo or mask cannot be read.
    """
    from hashlib import sha256

    from crossgrad_core.scene.fingerprint import fingerprint_of

    marks = fingerprint_of(scene, config.scene or Path())
    return sha256(marks.model_dump_json().encode()).hexdigest()


def read_scene(config: "RunConfig") -> "tuple[Scene, str]":
    """Return the checked scene of a configuration, and the name of the reader that read it.

    This function sets the number of CPU threads first.

    Raises:
        UserError: No reader accepts the folder, the reader fails, or points, poses and photos do
            not match.
    """
    from crossgrad_core.numerics.threads import configure_threads
    from crossgrad_core.run import assemble as assembling

    configure_threads(config.threads)
    if config.scene is None:
        raise UserError(
            "the command needs a scene", where="scene", todo="name the folder of a scene"
        )
    return assembling.read_and_check(config, config.scene)


def assemble_new(config: "RunConfig", scene: "Scene", reader: str) -> "Setup":
    """Assemble a run like `assemble`, but also refuse settings and labels that have no effect.

    Raises:
        UserError: A setting would change nothing; see also `assemble`.
    """
    from crossgrad_core.recipe import table
    from crossgrad_core.run import assemble as assembling
    from crossgrad_core.run import unused_settings as nothing
    from crossgrad_core.training import step

    setup = assembling.assemble(config, scene, reader)
    nothing.refuse_labels_for_nothing(setup)
    nothing.refuse_settings_for_nothing(table.open_again(config), setup)
    step.check_largest_draw(setup)
    return setup


def resolved(setup: "Setup") -> dict[str, Any]:
    """Return the configuration that a run writes: plain data with all options of all components."""
    from crossgrad_core.run import resolve

    return resolve.resolved(setup).model_dump(mode="json")


def available_cores() -> tuple[int, ...]:
    """Return the cores that this process may use; a container's CPU quota limits their number."""
    import os

    from crossgrad_core.system import cores

    count = cores.available_cores()
    affinity = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else range(count)
    return tuple(affinity[:count])


def available_memory() -> int | None:
    """Return the number of bytes of available memory; None if the system does not report it."""
    import torch

    from crossgrad_core.training.memory import available_bytes

    return available_bytes(torch.device("cpu"))


def summary_of(folder: Path) -> dict[str, Any] | None:
    """Return the content of a run's summary.json; None if the file is missing or damaged.

    This function does not import torch.
    """
    from crossgrad_core.run.results.summary import FILE as SUMMARY
    from crossgrad_core.run.results.summary import read_summary

    try:
        damaged = changed_files(folder, [SUMMARY])
        return None if damaged else read_summary(folder)
    except UserError:
        return None


def with_steps(setup: "Setup", steps: int) -> "Setup":
    """Return the setup with the standard schedule of a run of `steps` steps.

    The densifier does not change the times of this schedule.
    """
    from crossgrad_core.contract.schedule import Schedule

    counting = setup.schedule.counting
    return replace(setup, schedule=Schedule.for_run(steps, setup.config.schedule, counting))


def affordable_steps(setup: "Setup", seconds: float) -> int:
    """Return the number of steps that fit into `seconds` of training.

    The kernels are compiled first. The compilation time is not part of `seconds`.

    Raises:
        TrainingFailedError: The trial steps failed.
    """
    from crossgrad_core.training.budget import steps_for
    from crossgrad_core.training.start import warm_up
    from crossgrad_core.training.state import NonFiniteError, TrainingFailedError

    try:
        warm_up(setup)
        return steps_for(setup, seconds)[0]
    except NonFiniteError as error:
        raise TrainingFailedError(str(error)) from error


def take_steps(setup: "Setup", state: "TrainState") -> None:
    """Train to the end of the schedule without evaluating or saving anything.

    `state` is updated in place. To observe the training, register a plugin first:
    `setup.manager.register(plugin, name=...)`.

    Raises:
        TrainingFailedError: Training failed; `state` is the last valid state.
    """
    from crossgrad_core.training.loop import Stopper, train

    train(setup, state, _NoFolder(), Stopper())


class _NoFolder:
    """A replacement for the writer of a run's folder; it discards all results."""

    def evaluate(self, setup: "Setup", state: "TrainState") -> None:
        pass

    def save(self, setup: "Setup", state: "TrainState") -> None:
        pass

    def rewind(self, setup: "Setup", step: int) -> None:
        pass

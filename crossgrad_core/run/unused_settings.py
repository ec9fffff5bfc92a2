"""Checks that refuse settings without an effect on a new run, with the reason and a remedy.

A resumed run is not checked, because its settings were accepted at its start.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from crossgrad_core.config import AUTO, ComponentChoice, RunConfig
from crossgrad_core.contract.objections import set_for_nothing
from crossgrad_core.contract.scene_options import SceneOptions
from crossgrad_core.defaults import GROUP_SAMPLER, PLAIN_INITIALIZER, PROGRESS
from crossgrad_core.errors import UserError
from crossgrad_core.registry.entries import build
from crossgrad_core.run.assemble import reasons_against, refuse
from crossgrad_core.run.resolve import ALWAYS
from crossgrad_core.run.select import rules_of
from crossgrad_core.scene.split import TEST_LIST, TRAIN_LIST
from crossgrad_core.training.rates import axes_of
from crossgrad_core.training.schedules import MOST_DEGREES
from crossgrad_core.training.setup import Setup
from crossgrad_core.wording import listed, plural

_SLOTS = ("grouping", *ALWAYS)
_TIMES = ("densify_from", "densify_until", "densify_every", "min_refinements")


def refuse_labels_for_nothing(setup: Setup) -> None:
    """Validate the selection again when the labels of the training views are known.

    Raises:
        IncompatibleSelectionError: A component needs labels that no view has.
    """
    if setup.groups is None:
        return
    labels = tuple(dict.fromkeys(setup.groups))
    selection = replace(setup.selection, labels=labels)
    answers = setup.hook.crossgrad_validate_selection(selection=selection)
    refuse(reasons_against(setup.config, selection, answers))


def refuse_settings_for_nothing(config: RunConfig, setup: Setup) -> None:
    """Refuse settings of the user that have no effect in this run.

    Args:
        config: The settings of the user, without the recipe's decisions.
        setup: The assembled run.

    Raises:
        UserError: A setting would change nothing.
    """
    ineffective = [
        *_of_components(config, setup),
        *_of_density_control(config, setup),
        *_of_resets(config, setup),
        *_of_views(config, setup),
        *_of_the_schedule(config, setup),
        *_of_groups(config, setup),
        *_of_exposure(config, setup),
        *_of_the_split(config),
        *_of_positions(config, setup),
        *_of_the_start(config),
        *_of_rules(config, setup),
    ]
    if ineffective:
        raise UserError(
            "some settings would have no effect",
            where=listed(name for name, _ in ineffective),
            found="; ".join(f"{name}: {why}" for name, why in ineffective),
            todo="leave these settings out, or change the setting that makes them ineffective",
        )


def _of_components(config: RunConfig, setup: Setup) -> Iterator[tuple[str, str]]:
    for slot in _SLOTS:
        yield from _of_choice(slot, slot, getattr(config, slot), setup)
    links = config.operators
    for link in links:
        # In a chain, the key of an operator's option contains the name of the operator.
        setting = "operator" if len(links) == 1 else f"operator.{link.name}"
        yield from _of_choice("operator", setting, link, setup)


def _of_choice(
    slot: str, setting: str, choice: ComponentChoice | None, setup: Setup
) -> Iterator[tuple[str, str]]:
    if choice is None or not choice.options:
        return
    name = setup.selection.names[slot] if choice.name == AUTO else choice.name
    # Build the component with the user's options, because the component of the run was fitted to
    # the scene and may lack some of these options.
    component = build(plural(slot), name, choice.options)
    for option, why in set_for_nothing(component, setup.selection).items():
        yield f"{setting}.{option}", why


def _of_density_control(config: RunConfig, setup: Setup) -> Iterator[tuple[str, str]]:
    densifier, name = setup.densifier, setup.selection.names["densifier"]
    for setting in _TIMES:
        if getattr(config, setting) is not None and not densifier.edits:
            yield setting, f"densifier {name} makes no edits"
    if config.growth == "budget" and not densifier.edits:
        yield "growth", f"densifier {name} makes no edits"
    # If `max_gaussians` is a number, it also limits the initial points.
    if not densifier.edits and config.max_gaussians == AUTO:
        yield (
            "max_gaussians",
            f"densifier {name} makes no edits, and auto does not limit the initial Gaussians",
        )
    elif not densifier.edits and config.max_gaussians and config.data.init_file is not None:
        yield (
            "max_gaussians",
            f"densifier {name} makes no edits, and the Gaussians of a PLY file are used unchanged",
        )


def _of_resets(config: RunConfig, setup: Setup) -> Iterator[tuple[str, str]]:
    if config.reset_every and not setup.densifier.resets:
        yield (
            "reset_every",
            f"densifier {setup.selection.names['densifier']} makes no opacity resets",
        )
    # A run with a time budget reports options without effect as a note when its length is planned.
    if not (config.seconds or config.planned_seconds):
        yield from without_resets(config, setup)


def without_resets(config: RunConfig, setup: Setup) -> Iterator[tuple[str, str]]:
    """Yield options of the densifier that have no effect without opacity resets, with reasons."""
    if config.densifier is None or setup.schedule.reset_every is not None:
        return
    densifier, given = setup.densifier, config.densifier.options
    fields = type(densifier).model_fields
    for option in sorted(densifier.reset_options & given.keys()):
        if getattr(densifier, option) != fields[option].default:
            yield f"densifier.{option}", "the run has no opacity resets; add --set reset_every=N"


def _of_views(config: RunConfig, setup: Setup) -> Iterator[tuple[str, str]]:
    """Yield settings about the views of a step that have no effect, with reasons."""
    densifier, name = setup.densifier, setup.selection.names["densifier"]
    one = setup.selection.views_per_step == 1
    if config.densify_views != "all" and not (densifier.edits and densifier.observes):
        yield "densify_views", f"densifier {name} uses no statistics of views"
    elif config.densify_views == "one" and one:
        yield "densify_views", "a step has one view; add --views with more views"
    if config.batch_rule != "none" and one:
        yield "batch_rule", "a step has one view; add --views with more views"


def _of_the_schedule(config: RunConfig, setup: Setup) -> Iterator[tuple[str, str]]:
    if config.schedule_length is not None and config.schedule == "scaled":
        yield (
            "schedule_length",
            "--schedule scaled uses the length of the run; add --schedule absolute",
        )
    if config.clock == "cpu" and not (config.seconds or config.planned_seconds):
        yield "clock", "the length of the run is not given in seconds; add --seconds"
    stop, total = config.stop_after, setup.schedule.total
    # Accept any `stop_after` in a run with a time budget, because the run may become longer.
    if stop is not None and stop > total and not (config.seconds or config.planned_seconds):
        yield "stop_after", f"the run ends after step {total}"
    if config.min_refinements and not setup.schedule.min_refinements:
        why = "published times and times set by the user are not adapted"
        yield "min_refinements", f"densification times in steps, {why}"
    yield from _of_harmonics(config, setup)


def _of_harmonics(config: RunConfig, setup: Setup) -> Iterator[tuple[str, str]]:
    if config.sh_start and not any(block.rests for block in setup.trained_blocks):
        name = setup.selection.names["backbone"]
        yield "sh_start", f"backbone {name} trains no SH bands above the first"
    elif config.sh_start and setup.schedule.sh_from >= MOST_DEGREES:
        yield "sh_start", "all SH bands are rendered from the first step on (sh_from, --init)"


def _of_groups(config: RunConfig, setup: Setup) -> Iterator[tuple[str, str]]:
    """Yield the grouping if the user named a grouping that no component reads."""
    selection = setup.selection
    sampler, operator = selection.sampler, selection.operator
    watched = any(choice.name != PROGRESS for choice in config.observers)
    named = config.grouping is not None and config.grouping.name != AUTO
    if not named or sampler.reads_groups or watched:
        return
    if sampler.own_labels:
        yield "grouping", f"sampler {selection.names['sampler']} makes its own groups"
    elif not operator.reads_labels():
        yield (
            "grouping",
            (
                f"sampler {selection.names['sampler']} draws from all views without groups, "
                f"and operator {selection.names['operator']} uses no labels; --sampler "
                f"{GROUP_SAMPLER} draws from groups, --set grouping=null removes the grouping "
                "of a file"
            ),
        )


def _of_exposure(config: RunConfig, setup: Setup) -> Iterator[tuple[str, str]]:
    if config.exposure_from is not None and not setup.per_photo:
        name = setup.selection.names["exposure"]
        yield (
            "exposure_from",
            (
                f"exposure {name} has no per-photo values; choose with --exposure NAME the "
                "exposure that wrote the file"
            ),
        )


def _of_the_split(config: RunConfig) -> Iterator[tuple[str, str]]:
    data = config.data
    if data.test_every == SceneOptions.model_fields["test_every"].default:
        return
    if data.split == "none":
        yield "data.test_every", "--split none holds out no photo"
    lists = [name for name in (TRAIN_LIST, TEST_LIST) if _is_there(config.scene, name)]
    if data.split == "auto" and lists:
        yield (
            "data.test_every",
            f"{listed(lists)} determine the split; --split every ignores the lists",
        )


def _of_the_start(config: RunConfig) -> Iterator[tuple[str, str]]:
    asked = config.initializer is not None and config.initializer.name != PLAIN_INITIALIZER
    if asked and config.data.init != "points":
        yield (
            "initializer",
            f"--init {config.data.init} has its own points; leave out one of the two options",
        )
    if config.data.points is not None and config.data.init != "points":
        yield "data.points", f"--init {config.data.init} starts from other points"


def _of_rules(config: RunConfig, setup: Setup) -> Iterator[tuple[str, str]]:
    for name, rule in rules_of(config).items():
        if why := rule.unused(setup.backbone, setup.scene):
            yield f"rules.{name}", why


def _of_positions(config: RunConfig, setup: Setup) -> Iterator[tuple[str, str]]:
    if config.position_lr == "per-axis" and axes_of(setup) is None:
        name = setup.selection.names["backbone"]
        yield "position_lr", f"backbone {name} does not train Gaussians with axes"


def _is_there(scene: Path | None, name: str) -> bool:
    return scene is not None and (scene / name).is_file()

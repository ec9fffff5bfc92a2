"""`crossgrad diagnose`: a model, its probes, the report."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from crossgrad_core.commands import (
    ComponentChoice,
    RunConfig,
    Setup,
    TrainingFailedError,
    TrainState,
    affordable_steps,
    assemble,
    begin,
    build,
    model_of,
    read_scene,
    take_steps,
    text_bytes,
    with_steps,
    write_atomically,
)
from crossgrad_core.plugin import Grouping, Model, Scene
from crossgrad_plugins.diagnostics.exposure import exposure_of
from crossgrad_plugins.diagnostics.plan import (
    DEFAULT_GROUPING,
    OF_THE_RUN,
    ProbePlan,
    labelled,
    plan_probe,
    require_views,
)
from crossgrad_plugins.diagnostics.probe import ModelProbe
from crossgrad_plugins.diagnostics.report import Report
from crossgrad_plugins.diagnostics.watch import Watch


@dataclass(frozen=True)
class Options:
    """How a scene is diagnosed.

    Attributes:
        grouping: The grouping; by default that of the run, or else the paper's.
        per_group: Probed views per group.
        probes: Probes during the vanilla run, evenly spaced; the last one at its end.
        seconds: Training seconds of the vanilla run.
        seed: Seed of the vanilla run and of the probes.
        signature: File for the labels of grouping `conflict-signature`, or None.
    """

    grouping: ComponentChoice | None = None
    per_group: int = 12
    probes: int = 4
    seconds: float = 60.0
    seed: int = 0
    signature: Path | None = None


def diagnose_scene(config: RunConfig, options: Options) -> Report:
    """Trains a short vanilla run (one view per step, epoch order, plain sum) and probes it.

    Args:
        config: Scene, reading options, device and threads; components are replaced.
        options: How to probe.

    Returns:
        The report. Where training failed after the first probe it holds the probes so far, and
        `failure` says what happened.

    Raises:
        UserError: The scene cannot be read, has too few training photos, or the grouping cannot
            group it.
        TrainingFailedError: Training failed before the first probe.
    """
    vanilla = config.model_copy(
        update={
            "backbone": ComponentChoice(name="vanilla"),
            "sampler": ComponentChoice(name="epoch"),
            "operator": ComponentChoice(name="sum"),
            "views_per_step": 1,
            "seed": options.seed,
        }
    )
    scene, reader = read_scene(vanilla)
    plan = _plan(scene, options)
    setup = assemble(vanilla, scene, reader)
    steps = affordable_steps(setup, options.seconds)
    setup = with_steps(setup, steps)
    watch = Watch(plan, max(1, steps // options.probes), steps, options.seed)
    setup.manager.register(watch, name="diagnostics")
    state = begin(setup)
    model = f"a vanilla run of {steps} steps, one view each, in epoch order"
    try:
        take_steps(setup, state)
    except TrainingFailedError as error:
        if watch.last is None:
            raise
        model = f"{model}, which failed; probed before that"
        return replace(_report(model, watch, model_of(setup, state), options), failure=str(error))
    return _report(model, watch, model_of(setup, state), options)


def diagnose_run(setup: Setup, state: TrainState, folder: Path, options: Options) -> Report:
    """Probes a run where it is.

    Raises:
        UserError: Its scene has too few training photos, or the grouping cannot group it.
    """
    plan = _plan(setup.scene, options, setup.groups)
    watch = Watch(plan, 1, state.step, options.seed)
    model = model_of(setup, state)
    watch.crossgrad_model_ready(model)
    names = setup.selection.names
    which = (
        f"run {folder} ({names['backbone']}, {names['sampler']}, {names['operator']}) "
        f"at step {state.step}"
    )
    return _report(which, watch, model, options)


def _plan(scene: Scene, options: Options, groups: tuple[str, ...] | None = None) -> ProbePlan:
    """The views to probe; `groups` are the labels that the probed run was trained with."""
    require_views(scene)
    if options.grouping is None and groups is not None:
        return plan_probe(scene, OF_THE_RUN, groups, options.per_group, options.seed)
    grouping = options.grouping or ComponentChoice(name=DEFAULT_GROUPING)
    labels, notes = labelled(scene, grouping.name, options.seed, grouping.options)
    plan = plan_probe(scene, grouping.name, labels, options.per_group, options.seed)
    return replace(plan, notes=notes)


def _report(which: str, watch: Watch, model: Model, options: Options) -> Report:
    report = watch.report(model.scene, which)
    notes = (model.scene.georeference.note, *report.notes)
    report = replace(report, notes=notes, exposure=exposure_of(model.scene))
    if options.signature is None:
        return report
    note = _write_signature(model, options.signature, options.seed)
    return replace(report, notes=(*report.notes, note))


def _write_signature(model: Model, path: Path, seed: int) -> str:
    """Writes the labels of `conflict-signature` for grouping `lists`."""
    scene = model.scene
    grouping = build(Grouping, "conflict-signature", {})
    rng = np.random.default_rng(seed)
    rule = grouping.fit(scene, rng, ModelProbe(model, rng))
    lines = [f"{view.name},{rule.label(view)}" for view in scene.views]
    write_atomically(path, text_bytes("\n".join(lines) + "\n"))
    return f"labels of conflict-signature in {path} (--grouping lists --set grouping.file={path})"

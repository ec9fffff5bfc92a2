"""The command `crossgrad diagnose`: choose a model, measure its gradients, write the report."""

import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

import numpy as np

from crossgrad_core.commands import (
    FAILED,
    ComponentChoice,
    RunConfig,
    Setup,
    TrainingFailedError,
    TrainState,
    UserError,
    affordable_steps,
    assemble,
    begin,
    build,
    check_file,
    check_folder,
    check_new,
    configured,
    disk_errors,
    model_of,
    one_line,
    open_run,
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
from crossgrad_plugins.diagnostics.report import FILES, PICTURE, PROBES, Report
from crossgrad_plugins.diagnostics.watch import Watch


@dataclass(frozen=True)
class Options:
    """Options of a diagnosis.

    Attributes:
        grouping: The grouping; None for the run's grouping, or, without one, the grouping of the
            paper.
        per_group: Number of probed views per group; a probe measures the gradients of these views.
        probes: Number of probes during the vanilla run, evenly spaced; the last probe is at its
            end.
        seconds: Training seconds of the vanilla run.
        seed: Seed of the vanilla run and of the probes.
        signature: Output file for the labels of grouping `conflict-signature`, or None.
    """

    grouping: ComponentChoice | None = None
    per_group: int = 12
    probes: int = 4
    seconds: float = 60.0
    seed: int = 0
    signature: Path | None = None


def diagnose(
    scene: Path | None,
    run: Path | None,
    settings: Mapping[str, object],
    options: Options,
    out: Path | None,
    accept_scene: bool = False,
) -> int:
    """Diagnose a scene or a run, print the report, and write it to a folder.

    Args:
        scene: Scene folder; the bundled scene is used if neither a scene nor a run is given.
        run: Folder of a run whose gradients are measured, or None.
        settings: Settings of the vanilla run in the format of `RunConfig` (data, device ...). If a
            run is given, only `device` and `threads` may be set.
        options: The options of the diagnosis.
        out: Output folder of the report.
        accept_scene: True to accept a run's scene even if parts of the scene have changed.

    Returns:
        The exit code: 0, or 1 if training failed. After a failure, the report contains the probes
            before it.

    Raises:
        UserError: The options, the scene or the run cannot be used.
    """
    if scene is not None and run is not None:
        raise UserError(
            "both a scene and a run were named; only one of them can be diagnosed",
            where="SCENE, --run",
            todo="leave SCENE out: the run stores the path of its scene",
        )
    _check_free(out)
    check_folder(out or run or Path("runs"))
    if options.signature is not None:
        check_file(options.signature)
        check_new(options.signature)
    stamp = datetime.now().astimezone().strftime("%Y%m%d-%H%M%S")
    if run is not None:
        setup, state = open_run(run, settings, accept_scene=accept_scene)
        report = diagnose_run(setup, state, run, options)
        folder = out or run / "diagnose" / stamp
    else:
        config = configured({**settings, "scene": scene})
        try:
            report = diagnose_scene(config, options)
        except TrainingFailedError as error:
            return _failed(f"{error}; nothing was probed before this error")
        folder = out or Path("runs") / report.scene / "diagnose" / stamp
    _write(report, folder)
    return 0 if report.failure is None else _failed(report.failure)


def _failed(why: str) -> int:
    print(f"training failed: {why}", file=sys.stderr)  # noqa: T201
    return FAILED


def _check_free(out: Path | None) -> None:
    if out is not None and (out / PROBES).exists():
        raise UserError(
            "the output folder already contains a report",
            where=out,
            todo="choose another --out, or remove the report",
        )
    if out is not None:
        check_new(*(out / name for name in FILES))


def _write(report: Report, folder: Path) -> None:
    with disk_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    report.write(folder)
    for line in report.lines():
        print(one_line(line))  # noqa: T201 - print the result of the command
    print(f"\ntables and {PICTURE} in {one_line(folder)}")  # noqa: T201


def diagnose_scene(config: RunConfig, options: Options) -> Report:
    """Train a short vanilla run and measure its gradients.

    A vanilla run has one view per step, epoch order and the plain sum of gradients.

    Args:
        config: Scene, data options, device and threads; its components are replaced by those of a
            vanilla run.
        options: The options of the diagnosis.

    Returns:
        The report. If training fails after the first probe, the report contains the earlier probes,
        and `failure` describes the failure.

    Raises:
        UserError: The scene cannot be read, has too few training photos, or cannot be divided by
            the grouping.
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
        model = f"{model}, which failed; the probes before the failure are shown"
        return replace(_report(model, watch, model_of(setup, state), options), failure=str(error))
    return _report(model, watch, model_of(setup, state), options)


def diagnose_run(setup: Setup, state: TrainState, folder: Path, options: Options) -> Report:
    """Measure the gradients of a run at its current step.

    Raises:
        UserError: The scene of the run has too few training photos, or cannot be divided by the
            grouping.
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
    """Choose the views to probe; `groups` are the labels from the training of the run."""
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
    """Write the labels of `conflict-signature` for grouping `lists`, and return a note."""
    scene = model.scene
    grouping = build(Grouping, "conflict-signature", {})
    rng = np.random.default_rng(seed)
    rule = grouping.fit(scene, rng, ModelProbe(model, rng))
    lines = [f"{view.name},{rule.label(view)}" for view in scene.views]
    write_atomically(path, text_bytes("\n".join(lines) + "\n"))
    return f"labels of conflict-signature in {path} (--grouping lists --set grouping.file={path})"

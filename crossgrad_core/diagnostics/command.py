"""What `crossgrad diagnose` does: a model, its probes, the report."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.config import ComponentChoice, RunConfig
from crossgrad_core.contexts import Model
from crossgrad_core.diagnostics.cameras import camera_rows, distances_of, grouping_rows
from crossgrad_core.diagnostics.plan import ProbePlan, labelled, plan_probe
from crossgrad_core.diagnostics.probe import Measurement, ModelProbe, measure
from crossgrad_core.diagnostics.report import Report
from crossgrad_core.diagnostics.table import Row, table
from crossgrad_core.errors import UserError
from crossgrad_core.files import write_atomically
from crossgrad_core.grouping import Grouping
from crossgrad_core.hooks import hookimpl
from crossgrad_core.registry import build
from crossgrad_core.scene.types import Scene
from crossgrad_core.schedule import Schedule
from crossgrad_core.threads import configure_threads
from crossgrad_core.training.assemble import assemble, read_scene
from crossgrad_core.training.loop import Stopper, train
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.start import first_state, steps_for, warm_up
from crossgrad_core.training.state import TrainState
from crossgrad_core.training.views import model_of


@dataclass(frozen=True)
class Options:
    """How a scene is diagnosed.

    Attributes:
        grouping: Name of the grouping.
        per_group: Probed views per group.
        probes: Probes during the vanilla run, evenly spaced; the last one at its end.
        seconds: Training seconds of the vanilla run.
        seed: Seed of the vanilla run and of the probes.
        signature: File for the labels of grouping `conflict-signature`, or None.
    """

    grouping: str = "radial"
    per_group: int = 12
    probes: int = 4
    seconds: float = 30.0
    seed: int = 0
    signature: Path | None = None


def diagnose_scene(config: RunConfig, options: Options) -> Report:
    """Trains a short vanilla run (one view per step, epoch order, plain sum) and probes it.

    Args:
        config: Scene, reading options, device and threads; components are replaced.
        options: How to probe.

    Raises:
        UserError: The scene cannot be read, or the grouping cannot group it.
    """
    configure_threads(config.threads)
    vanilla = config.model_copy(
        update={
            "backbone": ComponentChoice(name="vanilla"),
            "sampler": ComponentChoice(name="epoch"),
            "operator": ComponentChoice(name="sum"),
            "views": 1,
            "seed": options.seed,
        }
    )
    scene, reader = read_scene(vanilla, cast("Path", vanilla.scene))
    plan = _plan(scene, options)
    setup = assemble(vanilla, scene, reader)
    warm_up(setup)
    steps, _ = steps_for(setup, options.seconds)
    setup = replace(setup, schedule=Schedule.for_run(steps, vanilla.schedule))
    watcher = _Watcher(plan, options, distances_of(scene), max(1, steps // options.probes), steps)
    setup.manager.register(watcher, name="diagnostics")
    state = first_state(setup)
    train(setup, state, _NoSink(), Stopper())
    model = f"a vanilla run of {steps} steps, one view each, in epoch order"
    return _report(scene, model, plan, watcher, model_of(setup, state), options)


def diagnose_run(setup: Setup, state: TrainState, folder: Path, options: Options) -> Report:
    """Probes a run where it is.

    Raises:
        UserError: The grouping cannot group its scene.
    """
    plan = _plan(setup.scene, options)
    watcher = _Watcher(plan, options, distances_of(setup.scene), 1, state.step)
    model = model_of(setup, state)
    watcher.crossgrad_model(model)
    names = setup.selection.names
    which = (
        f"run {folder} ({names['backbone']}, {names['sampler']}, {names['operator']}) "
        f"at step {state.step}"
    )
    return _report(setup.scene, which, plan, watcher, model, options)


class _NoSink:
    """The vanilla run leaves no results."""

    def evaluate(self, setup: Setup, state: TrainState) -> None:
        pass

    def save(self, setup: Setup, state: TrainState) -> None:
        pass


@dataclass
class _Watcher:
    """Probes the model every so many steps, and at the end.

    Attributes:
        plan: The views.
        options: The seed.
        distances: Of the training views.
        every: Steps between probes.
        total: The last step.
        rows: What was found.
        last: The last measurement.
    """

    plan: ProbePlan
    options: Options
    distances: Mapping[str, NDArray[np.float64]]
    every: int
    total: int
    rows: list[Row] = field(default_factory=list)
    last: Measurement | None = None

    @hookimpl
    def crossgrad_model(self, model: Model) -> None:
        """Probes where it is time."""
        step = model.phase.step
        close_to_end = self.total - self.every < step < self.total
        if step != self.total and (step % self.every or close_to_end):
            return
        rng = np.random.default_rng(self.options.seed)
        self.last = measure(model, self.plan.views, rng)
        self.rows += table(self.last, self.plan, self.distances, self.options.seed)


def _plan(scene: Scene, options: Options) -> ProbePlan:
    labels, notes = labelled(scene, options.grouping, options.seed)
    plan = plan_probe(scene, options.grouping, labels, options.per_group, options.seed)
    return replace(plan, notes=notes)


def _report(
    scene: Scene,
    model: str,
    plan: ProbePlan,
    watcher: _Watcher,
    final: Model,
    options: Options,
) -> Report:
    last = watcher.last
    if last is None:
        raise UserError("the model was never probed", where=scene.name, todo="train longer")
    notes = [f"model: {model}", *plan.notes, *_dropped(last)]
    if options.signature is not None:
        notes.append(_write_signature(final, options.signature, options.seed))
    return Report(
        scene=scene.name,
        title=f"{scene.name}: {model}",
        probes=watcher.rows,
        cameras=camera_rows(scene),
        groupings=grouping_rows(scene, last, options.seed),
        notes=notes,
    )


def _dropped(measurement: Measurement) -> Sequence[str]:
    notes = []
    if measurement.dropped:
        listed = ", ".join(measurement.dropped)
        notes.append(f"left out, gradient not finite: {listed}")
    if measurement.share < 1.0:
        notes.append(f"gradients of a random {measurement.share:.0%} of the primitives")
    return notes


def _write_signature(model: Model, path: Path, seed: int) -> str:
    """Writes the labels of `conflict-signature` for grouping `lists`."""
    scene = model.scene
    grouping = cast("Grouping", build("groupings", "conflict-signature", {}))
    rng = np.random.default_rng(seed)
    found = grouping.label(scene, scene.views, rng, ModelProbe(model, rng))
    lines = [f"{view.name},{label}" for view, label in zip(scene.views, found.labels, strict=True)]
    write_atomically(path, ("\n".join(lines) + "\n").encode())
    return f"labels of conflict-signature in {path} (--grouping lists --set grouping.file={path})"

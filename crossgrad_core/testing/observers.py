"""Contract checks of observers: they survive every event and leave every seam answered."""

from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeAlias, cast

import torch

from crossgrad_core.contract.adam_state import AdamState
from crossgrad_core.contract.backbone import Backbone
from crossgrad_core.contract.contexts import (
    AggregateContext,
    Aggregated,
    Answer,
    Densified,
    DensifyContext,
    Draw,
    EvaluationReport,
    Model,
    RunInfo,
    SampleContext,
    Sampled,
    StepRecord,
)
from crossgrad_core.contract.densifier import Densifier
from crossgrad_core.contract.loss import Loss
from crossgrad_core.contract.marks import hookimpl
from crossgrad_core.contract.observer import Observer
from crossgrad_core.contract.rasterizer import Rasterizer
from crossgrad_core.contract.schedule import Schedule
from crossgrad_core.contract.topology import NO_EDIT
from crossgrad_core.defaults import BACKBONE, LOSS, NO_DENSIFIER, REFERENCE_RASTERIZER
from crossgrad_core.registry.entries import build
from crossgrad_core.registry.manager import call_seam, make_manager
from crossgrad_core.testing.aggregation import BLOCKS, aggregate_context, sample_gradients
from crossgrad_core.testing.backbones import created
from crossgrad_core.testing.components import COMPONENT_CHECKS
from crossgrad_core.testing.contract import Check, Make, require, revived
from crossgrad_core.testing.densifiers import DensifierRun
from crossgrad_core.testing.fixtures import STEPS, sample_phase, sample_scene, step_fields

#: The hooks of one run's manager; pluggy gives them no types.
Hooks: TypeAlias = Any

_VIEWS = (0, 4)


class _Components:
    """Stands in for the selected components: a fixed draw, the plain sum, no edit."""

    @hookimpl
    def crossgrad_sample_views(self, context: SampleContext) -> Sampled:
        return Sampled(Draw(_VIEWS))

    @hookimpl
    def crossgrad_aggregate_gradients(self, context: AggregateContext) -> Aggregated:
        return Aggregated(context.gradients.total())

    @hookimpl
    def crossgrad_densify(self, context: DensifyContext) -> Densified:
        return Densified(NO_EDIT)


@contextmanager
def _hooks(observer: Observer) -> Iterator[Hooks]:
    """The hooks with the observer registered; what it prints is kept off the terminal."""
    manager = make_manager({"components": _Components(), "observer": observer})
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        yield manager.hook


def _start(hooks: Hooks, folder: Path | None) -> None:
    hooks.crossgrad_run_start(
        run=RunInfo(
            folder=folder,
            scene=sample_scene(),
            config={"steps": STEPS, "seed": 0},
            schedule=Schedule.for_run(STEPS),
            blocks=BLOCKS,
            notes=("a note",),
        )
    )


def _step_end(hooks: Hooks, step: int, answers: list[Answer]) -> None:
    counts = {"zero": 1, "cloned": 2, "pruned": 1, "reset": 0}
    names = tuple(sample_scene().train_views[view].name for view in _VIEWS)
    record = StepRecord(step, _VIEWS, names, None, (0.2, 0.1), 40, counts, 0.01 * step)
    hooks.crossgrad_step_end(record=record)
    for answer in answers:
        for state in answer.states.values():
            revived(state)


def survives_every_event(make: Make[Observer]) -> None:
    """A whole run's events raise nothing, with a folder to write to and without one."""
    with TemporaryDirectory() as folder:
        for place in (Path(folder), None):
            with _hooks(make()) as hooks:
                _start(hooks, place)
                for step in (1, 2):
                    _step_end(hooks, step, _seams(hooks, step))
                    hooks.crossgrad_model(model=_model(step))
                hooks.crossgrad_evaluation(
                    report=EvaluationReport(2, {"step": 2, "psnr": 20.0, "ssim": None})
                )
                hooks.crossgrad_length(step=2, total=3)
                hooks.crossgrad_message(text="a line of text")
                hooks.crossgrad_run_end(status="finished")


def the_model_stays_untouched(make: Make[Observer]) -> None:
    """Looking at the model changes none of its tensors."""
    model, copy = _model(1), _model(1)
    with _hooks(make()) as hooks:
        _start(hooks, None)
        _step_end(hooks, 1, [])
        hooks.crossgrad_model(model=model)
    for name, tensor in model.parameters.items():
        same = torch.equal(tensor.detach(), copy.parameters[name].detach())
        require(same, f"the observer changes the parameters {name}")
    for name, moment in model.adam.exp_avg.items():
        require(not moment.any(), f"the observer changes the optimizer's moments of {name}")


def survives_an_early_end(make: Make[Observer]) -> None:
    """A run that fails before its first step ends without an error of the observer's own."""
    for status in ("failed", "stopped"):
        with _hooks(make()) as hooks:
            _start(hooks, None)
            hooks.crossgrad_run_end(status=status)


def seams_stay_answered(make: Make[Observer]) -> None:
    """Around each seam the observer returns an answer of the right kind and shape."""
    with _hooks(make()) as hooks:
        _start(hooks, None)
        sampled, aggregated, _ = _seams(hooks, 1)
    draw = cast("Sampled", sampled).draw
    require(len(draw.views) == len(_VIEWS), f"{len(_VIEWS)} views became {len(draw.views)}")
    gradients = sample_gradients(len(_VIEWS))[0]
    answered = cast("Aggregated", aggregated).gradients
    require(
        answered.keys() == gradients.keys(),
        f"gradients of {sorted(gradients)} became gradients of {sorted(answered)}",
    )
    for name, gradient in answered.items():
        expected = gradients[name]
        fits = gradient is None or (expected is not None and gradient.shape == expected.shape)
        require(fits, f"the aggregated gradient of {name} changes its shape")
        finite = gradient is None or gradient.isfinite().all()
        require(finite, f"the aggregated gradient of {name} is not finite")


def _model(step: int) -> Model:
    """The model of a new run on the sample scene."""
    backbone = build(Backbone, BACKBONE, {})
    parameters = created(backbone)
    return Model(
        phase=sample_phase(step),
        scene=sample_scene(),
        backbone=backbone,
        rasterizer=build(Rasterizer, REFERENCE_RASTERIZER, {}),
        parameters=parameters,
        adam=AdamState(
            exp_avg={name: torch.zeros_like(tensor) for name, tensor in parameters.items()},
            exp_avg_sq={name: torch.zeros_like(tensor) for name, tensor in parameters.items()},
            steps=dict.fromkeys(parameters, step),
        ),
        background=torch.zeros(3),
        loss=build(Loss, LOSS, {}),
        groups=None,
    )


def _seams(hooks: Hooks, step: int) -> list[Answer]:
    """The answers of the three seams of a step, as the training loop asks for them."""
    centers = sample_scene().centers
    sample = SampleContext(
        **step_fields(step), views_per_step=len(_VIEWS), groups=None, centers=centers, last=None
    )
    quiet = build(Densifier, NO_DENSIFIER, {})
    return [
        call_seam(hooks.crossgrad_sample_views, sample, Sampled),
        call_seam(
            hooks.crossgrad_aggregate_gradients,
            aggregate_context(sample_gradients(len(_VIEWS))),
            Aggregated,
        ),
        call_seam(hooks.crossgrad_densify, DensifierRun.of(quiet).context(step), Densified),
    ]


OBSERVER_CHECKS: tuple[Check[Observer], ...] = (
    *COMPONENT_CHECKS,
    survives_every_event,
    survives_an_early_end,
    the_model_stays_untouched,
    seams_stay_answered,
)

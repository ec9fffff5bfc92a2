"""Contract checks of observers: they survive every event and leave every seam answered."""

from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeAlias, cast

import torch
from torch import Tensor

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.adam_state import AdamState
from crossgrad_core.contract.backbone import Backbone
from crossgrad_core.contract.contexts import (
    AfterStepContext,
    AggregateContext,
    Aggregated,
    Answer,
    Densified,
    DensifyContext,
    Draw,
    EvaluationReport,
    Model,
    PixelContext,
    RegularizeContext,
    Regularized,
    RunInfo,
    SampleContext,
    Sampled,
    ScaleContext,
    Scaled,
    StepRecord,
)
from crossgrad_core.contract.densifier import Densifier
from crossgrad_core.contract.loss import Loss
from crossgrad_core.contract.marks import hookimpl
from crossgrad_core.contract.observer import Observer
from crossgrad_core.contract.rasterizer import Rasterizer
from crossgrad_core.contract.schedule import Schedule
from crossgrad_core.contract.state import PluginState
from crossgrad_core.contract.topology import NO_EDIT, Edit
from crossgrad_core.defaults import BACKBONE, LOSS, NO_DENSIFIER, REFERENCE_RASTERIZER
from crossgrad_core.registry.entries import build
from crossgrad_core.registry.manager import call_seam, make_manager
from crossgrad_core.run.select import select
from crossgrad_core.testing.aggregation import BLOCKS, aggregate_context, sample_gradients
from crossgrad_core.testing.backbones import created
from crossgrad_core.testing.components import COMPONENT_CHECKS
from crossgrad_core.testing.contract import (
    Check,
    Make,
    global_randomness_untouched,
    require,
    revived,
)
from crossgrad_core.testing.densifiers import DensifierRun, require_good
from crossgrad_core.testing.fixtures import STEPS, sample_phase, sample_scene, step_fields
from crossgrad_core.testing.in_a_run import gaussians_in_a_run, parameters_in_a_run
from crossgrad_core.testing.renders import renders_of

#: The hooks of one run's manager; pluggy gives them no types.
Hooks: TypeAlias = Any

_VIEWS = (0, 4)


class _Components:
    """Stands in for the selected components: a fixed draw, full size, the plain sum, no edit."""

    @hookimpl
    def crossgrad_sample_views(self, context: SampleContext) -> Sampled:
        return Sampled(Draw(_VIEWS))

    @hookimpl
    def crossgrad_choose_scales(self, context: ScaleContext) -> Scaled:
        return Scaled((1.0,) * len(_VIEWS))

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


def _step_end(hooks: Hooks, step: int, answers: list[Answer]) -> StepRecord:
    counts = {"zero": 1, "cloned": 2, "pruned": 1, "reset": 0}
    names = tuple(sample_scene().train_views[view].name for view in _VIEWS)
    record = StepRecord(step, _VIEWS, names, None, (0.2, 0.1), 40, counts, 0.01 * step)
    hooks.crossgrad_step_end(record=record)
    for answer in answers:
        _require_answer(answer, Answer)
    return record


def survives_every_event(make: Make[Observer]) -> None:
    """A whole run's events raise nothing, with a folder to write to and without one."""
    with TemporaryDirectory() as folder:
        for place in (Path(folder), None):
            observer = make()
            with _hooks(observer) as hooks:
                _start(hooks, place)
                last = None
                for step in (1, 2):
                    answers = _seams(hooks, observer, step, last)
                    last = _step_end(hooks, step, answers)
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
    observer = make()
    with _hooks(observer) as hooks:
        _start(hooks, None)
        sampled, scaled, aggregated, _ = _seams(hooks, observer, 1)
    draw, scales = cast("Sampled", sampled).draw, cast("Scaled", scaled).scales
    require(len(draw.views) == len(_VIEWS), f"{len(_VIEWS)} views became {len(draw.views)}")
    good = len(scales) == len(_VIEWS) and all(0.0 < scale <= 1.0 for scale in scales)
    require(good, f"{len(_VIEWS)} views get the scales {scales}; expected one in (0, 1] for each")
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


def questions_are_answered_in_kind(make: Make[Observer]) -> None:
    """Objections, weights, loss terms and edits can be used; parameters change by edits only."""
    config = RunConfig(scene="sample", device="cpu")
    selection, _ = select(config, sample_scene(), reader="sample")
    run = DensifierRun.of(build(Densifier, NO_DENSIFIER, {}))
    kept = {name: tensor.detach().clone() for name, tensor in run.parameters.items()}
    with _hooks(make()) as hooks, global_randomness_untouched():
        for reasons in hooks.crossgrad_objections(selection=selection):
            good = isinstance(reasons, list) and all(isinstance(each, str) for each in reasons)
            require(good, f"crossgrad_objections answers {reasons!r}, not a list of sentences")
        _start(hooks, None)
        for step, scale in ((1, 1.0), (2, 0.5), (600, 1.0)):
            _require_usable(hooks, run, step, scale)
    for name, tensor in run.parameters.items():
        same = torch.equal(tensor.detach(), kept[name])
        require(same, f"the observer changes the parameters {name} itself; answer with an edit")


def _require_usable(hooks: Hooks, run: DensifierRun, step: int, scale: float) -> None:
    shown, fields = run.context(step).render(0, scale), step_fields(step)
    same = {name: getattr(shown, name) for name in ("view", "camera", "scale", "mask")}
    pixels = PixelContext(**fields, **same, index=0, target=shown.photo)
    for weights in hooks.crossgrad_pixel_weights(context=pixels):
        size = shown.photo.shape[:2]
        fits = isinstance(weights, Tensor) and weights.is_floating_point() and weights.shape == size
        good = fits and ((weights >= 0.0) & weights.isfinite()).all()
        wanted = f"finite numbers of 0 or more, floating point, {list(size)}"
        require(good, f"crossgrad_pixel_weights answers {weights!r:.60}; expected {wanted}")
    fields |= {"parameters": parameters_in_a_run(run.parameters), "backbone": run.backbone}
    drawn = gaussians_in_a_run(shown.gaussians, run.backbone)
    for gaussians, view in ((drawn, shown.view), (None, None)):
        context = RegularizeContext(**fields, gaussians=gaussians, view=view)
        for answer in hooks.crossgrad_regularize(context=context):
            _require_answer(answer, Regularized)
            loss = answer.loss
            good = isinstance(loss, Tensor) and loss.ndim == 0 and loss.isfinite()
            require(good, f"the loss of crossgrad_regularize is {loss!r:.60}, no finite scalar")
    after = AfterStepContext(**fields, means_lr=1e-4, edited=False)
    for answer in hooks.crossgrad_after_step(context=after):
        _require_answer(answer, Densified)
        require(isinstance(answer.edit, Edit), f"the edit is {answer.edit!r}, not an Edit")
        require_good(answer.edit, run.backbone.blocks(), run.parameters)


def _require_answer(answer: Answer, kind: type[Answer]) -> None:
    require(isinstance(answer, kind), f"a hook answers {answer!r:.60}, not {kind.__name__}")
    for name, state in answer.states.items():
        require(isinstance(state, PluginState), f"the state of {name} is {state!r}, no PluginState")
        revived(state)


def _model(step: int) -> Model:
    """The model of a new run on the sample scene."""
    backbone = build(Backbone, BACKBONE, {})
    rasterizer = build(Rasterizer, REFERENCE_RASTERIZER, {})
    parameters, phase, scene = created(backbone), sample_phase(step), sample_scene()
    return Model(
        phase=phase,
        scene=scene,
        backbone=backbone,
        rasterizer=rasterizer,
        parameters=parameters,
        adam=AdamState(
            exp_avg={name: torch.zeros_like(tensor) for name, tensor in parameters.items()},
            exp_avg_sq={name: torch.zeros_like(tensor) for name, tensor in parameters.items()},
            steps=dict.fromkeys(parameters, step),
        ),
        background=torch.zeros(3),
        loss=build(Loss, LOSS, {}),
        groups=None,
        render=renders_of(scene, phase, backbone, rasterizer, parameters),
    )


def _seams(
    hooks: Hooks, observer: Observer, step: int, last: StepRecord | None = None
) -> list[Answer]:
    """The answers of the seams of a step, as the training loop asks for them.

    Gradients of single views are there only if the observer asks for them, and the views of the
    first step have no labels.
    """
    centers = sample_scene().centers
    sample = SampleContext(
        **step_fields(step), views_per_step=len(_VIEWS), groups=None, centers=centers, last=last
    )
    quiet = build(Densifier, NO_DENSIFIER, {})
    scale = ScaleContext(**step_fields(step), draw=Draw(_VIEWS), last=last)
    summed = not observer.needs_separate_gradients
    aggregate = aggregate_context(sample_gradients(len(_VIEWS)), summed=summed)
    if last is None:
        aggregate = replace(aggregate, labels=None)
    return [
        call_seam(hooks.crossgrad_sample_views, sample, Sampled),
        call_seam(hooks.crossgrad_choose_scales, scale, Scaled),
        call_seam(hooks.crossgrad_aggregate_gradients, aggregate, Aggregated),
        call_seam(hooks.crossgrad_densify, DensifierRun.of(quiet).context(step), Densified),
    ]


OBSERVER_CHECKS: tuple[Check[Observer], ...] = (
    *COMPONENT_CHECKS,
    survives_every_event,
    survives_an_early_end,
    the_model_stays_untouched,
    seams_stay_answered,
    questions_are_answered_in_kind,
)

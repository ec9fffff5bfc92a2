"""Contract checks for observers: events raise no errors, and wrapped hooks return valid results."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import replace
from io import StringIO
from itertools import count, pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Any, TypeAlias, cast

import torch
from torch import Tensor

from crossgrad_core.config import RunConfig
from crossgrad_core.contract.blocks import NO_EDIT, AdamState, Edit, PluginState
from crossgrad_core.contract.component import hookimpl
from crossgrad_core.contract.contexts import (
    AfterStepContext,
    AggregateContext,
    AggregateResult,
    Answer,
    DensifyContext,
    DensifyResult,
    EvaluationReport,
    Model,
    PixelContext,
    RegularizeContext,
    RegularizeResult,
    RunInfo,
    SampleContext,
    SampleResult,
    ScaleContext,
    ScaleResult,
    StepContext,
    StepRecord,
    ViewSample,
)
from crossgrad_core.contract.schedule import Schedule
from crossgrad_core.contract.slots.backbone import Backbone
from crossgrad_core.contract.slots.densifier import Densifier
from crossgrad_core.contract.slots.loss import Loss
from crossgrad_core.contract.slots.observer import Observer
from crossgrad_core.contract.slots.rasterizer import Rasterizer
from crossgrad_core.defaults import BACKBONE, LOSS, NO_DENSIFIER, REFERENCE_RASTERIZER
from crossgrad_core.registry.entries import build
from crossgrad_core.registry.manager import call_first_result, make_manager
from crossgrad_core.run.decisions import with_decisions
from crossgrad_core.run.select import select
from crossgrad_core.testing.backbones import created
from crossgrad_core.testing.densifiers import DensifierRun, require_good
from crossgrad_core.testing.fixtures import STEPS, sample_phase, sample_scene, step_fields
from crossgrad_core.testing.support.aggregation import BLOCKS, aggregate_context, sample_gradients
from crossgrad_core.testing.support.components import COMPONENT_CHECKS
from crossgrad_core.testing.support.contract import (
    Check,
    ContractError,
    Make,
    global_randomness_untouched,
    require,
    revived,
)
from crossgrad_core.testing.support.growth import (
    require_bounded,
    size_of,
    time_hooks,
    traced_memory,
)
from crossgrad_core.testing.support.renders import (
    gaussians_in_a_run,
    parameters_in_a_run,
    renders_of,
)
from crossgrad_core.wording import in_one_line

#: The hooks of one plugin manager; pluggy gives them no types.
Hooks: TypeAlias = Any

_VIEWS = (0, 4)
#: Steps that are checked: all early steps, then fewer and fewer steps up to the end of a run.
_STEPS = (*range(1, 17), 50, 100, 500, 600, 1_000, 7_000, 15_000, STEPS)


#: Hooks that are called inside a training step. The time of these hooks counts as training time.
_ON_THE_CLOCK = {
    "crossgrad_sample_views",
    "crossgrad_choose_scales",
    "crossgrad_pixel_weights",
    "crossgrad_regularize",
    "crossgrad_aggregate_gradients",
    "crossgrad_densify",
    "crossgrad_after_step",
}
#: Number of calls of a hook, and time limit in seconds for the fastest call. The fastest call is
#: used, because other programs may slow down some calls.
_CALLS, _SLOW = 6, 0.1
#: Number of bytes by which the memory may grow in each step, and number of steps between two memory
#: measurements.
_KEPT, _BLOCK = 100_000, 4


class _Components:
    """Replacements for the selected components: fixed views, full size, plain sum, no edit."""

    @hookimpl
    def crossgrad_sample_views(self, context: SampleContext) -> SampleResult:
        return SampleResult(ViewSample(_VIEWS))

    @hookimpl
    def crossgrad_choose_scales(self, context: ScaleContext) -> ScaleResult:
        return ScaleResult((1.0,) * len(_VIEWS))

    @hookimpl
    def crossgrad_aggregate_gradients(self, context: AggregateContext) -> AggregateResult:
        return AggregateResult(context.gradients.total())

    @hookimpl
    def crossgrad_densify(self, context: DensifyContext) -> DensifyResult:
        return DensifyResult(NO_EDIT)


@contextmanager
def _hooks(observer: Observer, seconds: dict[str, float] | None = None) -> Iterator[Hooks]:
    """Yield the hooks of a manager with the observer. Printed output of the observer is hidden.

    Args:
        observer: The observer.
        seconds: Dictionary that receives the wall time of the fastest call of each hook, by name.
            If `seconds` is None, no times are measured.
    """
    manager = make_manager({"components": _Components(), "observer": observer})
    if seconds is not None:
        time_hooks(manager, seconds)
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        yield manager.hook


def _start(hooks: Hooks, folder: Path | None) -> None:
    hooks.crossgrad_run_start(
        run=RunInfo(
            folder=folder,
            scene=sample_scene(),
            config={"steps": STEPS, "seed": 0, "device": "cpu"},
            schedule=Schedule.for_run(STEPS),
            blocks=BLOCKS,
            notes=("a note",),
        )
    )


def _record(step: int) -> StepRecord:
    counts = {"zero": 1, "cloned": 2, "pruned": 1, "reset": 0}
    names = tuple(sample_scene().train_views[view].name for view in _VIEWS)
    return StepRecord(step, _VIEWS, names, None, (0.2, 0.1), 40, counts, 0.01 * step)


def _step_end(hooks: Hooks, step: int, answers: list[Answer]) -> None:
    hooks.crossgrad_step_end(record=_record(step))
    for answer in answers:
        _require_answer(answer, Answer)


def survives_every_event(make: Make[Observer]) -> None:
    """No event of a run raises an error, with or without an output folder."""
    with TemporaryDirectory() as folder:
        for output_folder in (Path(folder), None):
            observer = make()
            with _hooks(observer) as hooks:
                _start(hooks, output_folder)
                for step in _STEPS if output_folder else (1, 2):
                    _require_survival(hooks, observer, step)
                hooks.crossgrad_evaluation(
                    report=EvaluationReport(2, {"step": 2, "psnr": 20.0, "ssim": None})
                )
                hooks.crossgrad_length_changed(step=2, total=3)
                hooks.crossgrad_log(text="a line of text")
                hooks.crossgrad_run_end(status="finished")


def _require_survival(hooks: Hooks, observer: Observer, step: int) -> None:
    """Require that the hooks of a step raise no error.

    Other checks test the results of the hooks.
    """
    try:
        _step_end(hooks, step, _step_hooks(hooks, observer, step))
        hooks.crossgrad_model_ready(model=_model(step))
    except ContractError:
        raise
    except (Exception, SystemExit) as error:
        raise ContractError(
            f"step {step}: a hook of the observer raises {in_one_line(error)}; an "
            "observer must not end a run: catch errors, and leave out the part that "
            "failed"
        ) from error


def the_model_stays_untouched(make: Make[Observer]) -> None:
    """The observer does not change any tensor of the model."""
    with _hooks(make()) as hooks:
        _start(hooks, None)
        for step in _STEPS:
            model = _model(step)
            _step_end(hooks, step, [])
            hooks.crossgrad_model_ready(model=model)
            _require_new(model, step)


def _require_new(model: Model, step: int) -> None:
    """Require that a model is still equal to a new model from `_model`."""
    same = _model(step).parameters
    for name, tensor in model.parameters.items():
        equal = torch.equal(tensor.detach(), same[name].detach())
        require(equal, f"step {step}: crossgrad_model_ready changes the parameters {name}")
    for name, moment in model.adam.exp_avg.items():
        changed = bool(moment.any())
        require(not changed, f"step {step}: crossgrad_model_ready changes the moments of {name}")


def survives_an_early_end(make: Make[Observer]) -> None:
    """If a run fails before its first step, the observer raises no error of its own."""
    for status in ("failed", "stopped"):
        with _hooks(make()) as hooks:
            _start(hooks, None)
            hooks.crossgrad_run_end(status=status)


def hooks_stay_answered(make: Make[Observer]) -> None:
    """If the observer wraps a hook, the hook still returns a valid result.

    The result is finite and has the right type and shape.
    """
    run, observer = DensifierRun.of(build(Densifier, NO_DENSIFIER, {})), make()
    with _hooks(observer) as hooks:
        _start(hooks, None)
        for step in _STEPS:
            sampled, scaled, aggregated, densified = _step_hooks(hooks, observer, step)
            _require_views(step, cast("SampleResult", sampled), cast("ScaleResult", scaled))
            _require_gradients(step, cast("AggregateResult", aggregated))
            edit = cast("DensifyResult", densified).edit
            require(isinstance(edit, Edit), f"step {step}: the edit is {edit!r}, not an Edit")
            require_good(edit, run.backbone.blocks(), run.parameters)


def _require_views(step: int, sampled: SampleResult, scaled: ScaleResult) -> None:
    drawn, scales = len(sampled.draw.views), scaled.scales
    require(drawn == len(_VIEWS), f"step {step}: {len(_VIEWS)} views became {drawn}")
    good = len(scales) == len(_VIEWS) and all(0.0 < scale <= 1.0 for scale in scales)
    wanted = "expected one in (0, 1] for each"
    require(good, f"step {step}: {len(_VIEWS)} views received the scales {scales}; {wanted}")


def _require_gradients(step: int, aggregated: AggregateResult) -> None:
    gradients, answered = sample_gradients(len(_VIEWS))[0], aggregated.gradients
    what = f"step {step}: a wrapper of crossgrad_aggregate_gradients returns"
    require(
        answered.keys() == gradients.keys(),
        f"{what} gradients of {sorted(answered)}; expected those of {sorted(gradients)}",
    )
    for name, gradient in answered.items():
        expected = gradients[name]
        fits = gradient is None or (expected is not None and gradient.shape == expected.shape)
        require(fits, f"{what} a gradient of {name} of another shape")
        finite = gradient is None or gradient.isfinite().all()
        require(finite, f"{what} a gradient of {name} that is not finite, for finite ones")


def questions_are_answered_in_kind(make: Make[Observer]) -> None:
    """The observer's hooks return valid results. Parameters change only through returned edits."""
    config = RunConfig(scene="sample", device="cpu")
    config, *_ = with_decisions(config, sample_scene())
    selection, _ = select(config, sample_scene(), reader="sample")
    run = DensifierRun.of(build(Densifier, NO_DENSIFIER, {}))
    kept = {name: tensor.detach().clone() for name, tensor in run.parameters.items()}
    with _hooks(make()) as hooks, global_randomness_untouched():
        for reasons in hooks.crossgrad_validate_selection(selection=selection):
            good = isinstance(reasons, list) and all(isinstance(reason, str) for reason in reasons)
            require(
                good, f"crossgrad_validate_selection returns {reasons!r}, not a list of strings"
            )
        _start(hooks, None)
        for step in _STEPS:
            _require_usable(hooks, run, step, 0.5 if step == 2 else 1.0)  # noqa: PLR2004
    for name, tensor in run.parameters.items():
        same = torch.equal(tensor.detach(), kept[name])
        require(same, f"the observer changes the parameters {name} itself; return an edit instead")


def _require_usable(hooks: Hooks, run: DensifierRun, step: int, scale: float) -> None:
    shown, fields = run.context(step).render(0, scale), step_fields(step)
    same = {name: getattr(shown, name) for name in ("view", "camera", "scale", "mask")}
    pixels = PixelContext(**fields, **same, index=0, target=shown.photo)
    for weights in hooks.crossgrad_pixel_weights(context=pixels):
        size = shown.photo.shape[:2]
        fits = isinstance(weights, Tensor) and weights.is_floating_point() and weights.shape == size
        good = fits and ((weights >= 0.0) & weights.isfinite()).all()
        wanted = f"finite floating-point numbers of at least 0, with shape {list(size)}"
        require(good, f"crossgrad_pixel_weights returns {weights!r:.60}; expected {wanted}")
    fields |= {"parameters": parameters_in_a_run(run.parameters), "backbone": run.backbone}
    drawn = gaussians_in_a_run(shown.gaussians, run.backbone)
    for gaussians, view in ((drawn, shown.view), (None, None)):
        context = RegularizeContext(**fields, gaussians=gaussians, view=view)
        for answer in hooks.crossgrad_regularize(context=context):
            _require_answer(answer, RegularizeResult)
            loss = answer.loss
            good = isinstance(loss, Tensor) and loss.ndim == 0 and loss.isfinite()
            require(good, f"the loss of crossgrad_regularize is {loss!r:.60}, not a finite scalar")
    after = AfterStepContext(**fields, means_lr=1e-4, edited=False)
    for answer in hooks.crossgrad_after_step(context=after):
        _require_answer(answer, DensifyResult)
        require(isinstance(answer.edit, Edit), f"the edit is {answer.edit!r}, not an Edit")
        require_good(answer.edit, run.backbone.blocks(), run.parameters)


def _require_answer(answer: Answer, kind: type[Answer]) -> None:
    # Format the result only after a failure, because formatting takes long.
    if not isinstance(answer, kind):
        raise ContractError(f"a hook returned {answer!r:.60}, not {kind.__name__}")
    for name, state in answer.states.items():
        require(
            isinstance(state, PluginState), f"the state of {name} is {state!r}, not a PluginState"
        )
        revived(state)


def _model(step: int) -> Model:
    """Create the model of a new run on the sample scene."""
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


def _step_hooks(
    hooks: Hooks,
    observer: Observer,
    step: int,
    states: Mapping[str, PluginState] = MappingProxyType({}),
) -> list[Answer]:
    """Call the hooks of a step as in the training loop, and return their results.

    Gradients of single views are available only if the observer declares that they are needed. In
    the first step, no record of a previous step exists, and views have no labels.
    """
    centers, last = sample_scene().centers, _record(step - 1) if step > 1 else None
    sample = SampleContext(
        **step_fields(step), views_per_step=len(_VIEWS), groups=None, centers=centers, last=last
    )
    quiet = build(Densifier, NO_DENSIFIER, {})
    scale = ScaleContext(**step_fields(step), draw=ViewSample(_VIEWS), last=last)
    summed = not observer.needs_separate_gradients
    gradients = aggregate_context(sample_gradients(len(_VIEWS)), summed=summed)
    if last is None:
        gradients = replace(gradients, labels=None)
    asked: list[tuple[Any, StepContext, type[Answer]]] = [
        (hooks.crossgrad_sample_views, sample, SampleResult),
        (hooks.crossgrad_choose_scales, scale, ScaleResult),
        (hooks.crossgrad_aggregate_gradients, replace(gradients, step=step), AggregateResult),
        (hooks.crossgrad_densify, DensifierRun.of(quiet).context(step), DensifyResult),
    ]
    answers = []
    for hook, context, kind in asked:
        answers.append(call_first_result(hook, replace(context, states=states), kind))
        states = {**states, **answers[-1].states}
    return answers


def states_stay_bounded(make: Make[Observer]) -> None:
    """The states of the observer's wrappers do not grow with the number of steps."""
    observer = make()
    with _hooks(observer) as hooks:
        _start(hooks, None)
        require_bounded((_size(states) for states in _states(hooks, observer)), "a wrapper")


def _states(hooks: Hooks, observer: Observer) -> Iterator[Mapping[str, PluginState]]:
    """Yield all states after each step of a run without an end."""
    states: Mapping[str, PluginState] = {}
    for step in count(1):
        for answer in _step_hooks(hooks, observer, step, states):
            states = {**states, **answer.states}
        yield states


def _size(states: Mapping[str, PluginState]) -> int:
    return sum(map(size_of, states.values()))


def nothing_piles_up(make: Make[Observer]) -> None:
    """The memory of the observer grows only a little in each step."""
    observer, model = make(), _model(1)
    summed = not observer.needs_separate_gradients
    gradients = aggregate_context(sample_gradients(len(_VIEWS)), summed=summed)
    with _hooks(observer) as hooks, traced_memory() as memory:
        _start(hooks, None)
        kept = []
        for step in range(1, 4 * _BLOCK + 1):
            hooks.crossgrad_aggregate_gradients(context=replace(gradients, step=step))
            _step_end(hooks, step, [])
            hooks.crossgrad_model_ready(model=model)
            if step % _BLOCK == 0:
                kept.append(memory())
    # Ignore the first steps. In the first steps, an observer may allocate memory that is reused
    # later, such as a buffer.
    grown = min(later - earlier for earlier, later in pairwise(kept[1:])) / _BLOCK
    require(
        grown <= _KEPT,
        f"the observer uses {grown / 1000000.0:.1f} MB more memory after each step "
        "(crossgrad_step_end, crossgrad_model_ready, wrappers); expected at most "
        f"{_KEPT / 1000000.0:g} MB, so that 30,000 steps fit into memory: keep sums, "
        "or write to the run's folder",
    )


def steps_are_not_held_up(make: Make[Observer]) -> None:
    """No hook that is called in each step is slow. The fastest of several calls is measured."""
    run, observer = DensifierRun.of(build(Densifier, NO_DENSIFIER, {})), make()
    seconds: dict[str, float] = {}
    with _hooks(observer, seconds) as hooks:
        _start(hooks, None)
        for step in range(1, _CALLS + 1):
            _step_hooks(hooks, observer, step)
            _require_usable(hooks, run, step, 1.0)
    for name in _ON_THE_CLOCK & seconds.keys():
        require(
            seconds[name] <= _SLOW,
            f"the fastest of {_CALLS} calls of {name} takes {seconds[name]:.2f} s, with "
            f"40 Gaussians and 24 x 16 pixels; expected at most {_SLOW:g} s: do slow work "
            "only in some steps, or in an event, whose time is not counted",
        )


OBSERVER_CHECKS: tuple[Check[Observer], ...] = (
    *COMPONENT_CHECKS,
    survives_every_event,
    survives_an_early_end,
    the_model_stays_untouched,
    hooks_stay_answered,
    questions_are_answered_in_kind,
    states_stay_bounded,
    nothing_piles_up,
    steps_are_not_held_up,
)

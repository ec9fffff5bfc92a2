"""One training step: sample views, render, aggregate gradients, optimize, densify."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from crossgrad_core.contract.blocks import (
    EMPTY_STATE,
    AdamRule,
    AdamState,
    Block,
    Edit,
    Parameters,
    PluginState,
    apply_to_moment,
    apply_to_parameters,
    gather_indices,
    misfit_of,
)
from crossgrad_core.contract.contexts import (
    AfterStepContext,
    AggregateContext,
    AggregateResult,
    Answer,
    DensifyContext,
    DensifyResult,
    Model,
    SampleContext,
    SampleResult,
    StepRecord,
    ViewRecord,
    ViewSample,
)
from crossgrad_core.contract.gradients import Gradients
from crossgrad_core.contract.scene import Scene
from crossgrad_core.contract.slots import sampler
from crossgrad_core.contract.slots.grouping import GroupingRule, Regrouping
from crossgrad_core.contract.slots.rule import FinalEdit
from crossgrad_core.errors import UserError
from crossgrad_core.gradients.finite import is_finite
from crossgrad_core.gradients.sparse_rows import coalesced, dense
from crossgrad_core.registry.manager import call_all, call_first_result, one_by_one, wrong_answer
from crossgrad_core.training.adam.adam import adam_step
from crossgrad_core.training.adam.adam import counted as one_more
from crossgrad_core.training.adam.axes import step_along_axes
from crossgrad_core.training.growth_budget import max_new_gaussians
from crossgrad_core.training.per_image_params import apply, take_photo_step
from crossgrad_core.training.rates import axes_of, means_rate_at, rates_at, rule_at
from crossgrad_core.training.rngs import make_streams
from crossgrad_core.training.rules import eval_parameters
from crossgrad_core.training.setup import Scale, Setup
from crossgrad_core.training.state import NonFiniteError, TrainState
from crossgrad_core.training.views import (
    RenderCallback,
    Rendered,
    TensorGradients,
    add_regularization,
    context_fields,
    eval_background,
    joined,
    observe_view,
    render_views,
    scales_of,
)
from crossgrad_core.wording import listed


def model_of(setup: Setup, state: TrainState) -> Model:
    """Return the model after the last step. The model and `state` share their tensors."""
    return Model(
        phase=setup.phase(state.step, training=True),
        scene=setup.scene,
        backbone=setup.backbone,
        rasterizer=setup.rasterizer,
        parameters=state.parameters,
        adam=state.adam,
        background=eval_background(setup),
        loss=setup.loss,
        exposed=partial(apply, setup, state),
        rule=rule_at(setup, state.step + 1),
        render=RenderCallback(setup, state, counted=False),
        groups=setup.groups,
    )


#: `GROUPING`: key of the state that contains the labels, and name of the grouping's random stream.
#: `_LABELS`: key of the labels in this state.
GROUPING = "grouping"
_LABELS = "labels"


def regroup_if_due(setup: Setup, state: TrainState) -> None:
    """Group the training views again if the last completed step is the grouping's `refit_after`.

    The state of the sampler is reset, because this state refers to the old groups of views.
    """
    grouping = setup.selection.grouping
    if not isinstance(grouping, Regrouping) or state.step != grouping.refit_after:
        return
    rule = grouping.refit(model_of(setup, state), state.rngs[GROUPING])
    labels = labels_of(rule, setup.scene, setup.selection.names["grouping"])
    state.commit({GROUPING: PluginState({_LABELS: list(labels)}), sampler.STATE: EMPTY_STATE})
    for note in rule.notes:
        setup.hook.crossgrad_log(text=f"step {state.step}: {note}")


def labels_of(rule: GroupingRule, scene: Scene, name: str) -> tuple[str, ...]:
    """Return one label for each training view, computed by the rule of the grouping `name`."""
    labels, views = tuple(rule.labels(scene.train_views)), scene.train_views
    if len(labels) == len(views):
        return labels
    raise UserError(
        f"grouping {name} returned a wrong number of labels",
        found=f"{len(labels)} labels of {len(views)} training views",
        todo="choose another --grouping, or repair the plugin",
    )


def groups_of(setup: Setup, state: TrainState) -> tuple[str, ...] | None:
    """Return the present label of each training view; None without a grouping."""
    labels = state.states.get(GROUPING, EMPTY_STATE).values.get(_LABELS)
    return tuple(map(str, labels)) if isinstance(labels, list) else setup.groups


#: Name of the random stream for all random numbers of extra views.
STREAM = "density"


def observed_views(
    setup: Setup, state: TrainState, records: Sequence[ViewRecord]
) -> tuple[ViewRecord, ...]:
    """Return the records of views for density control.

    The records include an extra view in the steps that require one.

    Raises:
        NonFiniteError: The loss of the extra view is not finite.
    """
    if setup.config.densify_views == "one":
        # In each step, use another position of the sample. A sampler may always put one group of
        # views first.
        return (records[state.step % len(records)],)
    wanted = setup.schedule.grows and setup.schedule.collects(state.step)
    if setup.config.densify_views != "extra" or not wanted:
        return tuple(records)
    # All random numbers for the extra view come from this stream, also for its background and
    # plugins.
    streams, states = dict.fromkeys(state.rngs, state.rngs[STREAM]), dict(state.states)
    state = replace(state, rngs=streams, states=states)
    index = int(state.rngs[STREAM].integers(len(setup.train_views)))
    groups = groups_of(setup, state)
    draw = ViewSample((index,), None if groups is None else (groups[index],))
    return (*records, observe_view(setup, state, draw, scales_of(setup, state, draw)[0]))


#: With fewer Gaussians than this number, sorting in memory does not help. For 2^14 Gaussians with
#: 59 parameters each, the parameters and moments use 12 MB.
FEWEST_SORTED = 2**14
#: `_BITS`: bits of each coordinate in a Morton code of 63 bits. `_CELLS`: number of cells per unit
#: of the local frame. All cameras together span about one unit. Positions more than 128 units from
#: the origin are clamped to the outermost cells.
_BITS = 21
_CELLS = 2**13
#: Shifts and masks that insert two zero bits after each bit of a number (Morton interleaving).
_SPREAD = (
    (32, 0x001F00000000FFFF),
    (16, 0x001F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


def along_curve(positions: Tensor) -> Tensor:
    """Return [N] int64, the rows of `positions` [N, 3] (local frame) in Morton order.

    Rows with equal codes keep their order.
    """
    highest = 2**_BITS - 1
    cells = torch.nan_to_num(positions.detach().double() * _CELLS + 2 ** (_BITS - 1), nan=0.0)
    codes = cells.clamp(0, highest).long()
    for shift, mask in _SPREAD:
        codes = (codes | (codes << shift)) & mask
    return torch.argsort(codes[:, 0] | (codes[:, 1] << 1) | (codes[:, 2] << 2), stable=True)


def in_order(parameters: Parameters, blocks: tuple[Block, ...], name: str) -> Tensor | None:
    """Return [N] int64, the rows of the primitives in Morton order.

    Return None if the order should not change.

    Args:
        parameters: The parameters in their present order.
        blocks: The blocks of the backbone.
        name: Name of the tensor of positions. If no block contains this tensor, the order does not
            change.
    """
    if not any(block.per_primitive and name in block.tensors for block in blocks):
        return None
    return along_curve(parameters[name]) if len(parameters[name]) >= FEWEST_SORTED else None


def ordered(parameters: Parameters, blocks: tuple[Block, ...], name: str) -> Parameters:
    """Return the parameters with the primitives in Morton order (see `in_order`)."""
    rows = in_order(parameters, blocks, name)
    return (
        parameters if rows is None else apply_to_parameters(Edit(source=rows), blocks, parameters)
    )


def apply_edit(setup: Setup, state: TrainState, edit: Edit) -> bool:
    """Apply an edit to the parameters, their moments and the plugin states.

    Returns:
        True if the edit added, removed or reordered primitives.

    Raises:
        UserError: The edit does not match the parameters.
    """
    if edit.is_empty:
        return False
    _check_edit(setup, state, edit)
    _apply(setup, state, edit)
    if edit.source is None:
        return False
    phase = setup.phase(state.step, training=True)
    state.tensors = setup.backbone.prepare(state.tensors, setup.scene, phase)
    return True


def _check_edit(setup: Setup, state: TrainState, edit: Edit) -> None:
    if misfit := misfit_of(edit, setup.blocks, state.tensors):
        raise UserError(
            "a plugin's edit does not match the Gaussians",
            where=f"step {state.step}, densifier {setup.selection.names['densifier']} or a plugin "
            "that acts after steps",
            found=misfit,
            todo="repair the plugin; `crossgrad plugins check` tests its edits",
        )


def final_edits(setup: Setup, state: TrainState) -> Iterator[FinalEdit]:
    """Apply and yield the final edits of a finished run.

    Values that the backbone derives are not updated.

    If an error interrupts an edit, the state before this edit is kept.

    Raises:
        UserError: An edit does not match the parameters.
    """
    for hook in one_by_one(setup.manager, "crossgrad_final_edit"):
        shown = eval_parameters(setup, state)
        model = replace(
            model_of(setup, state),
            phase=setup.phase(state.step, training=False),
            parameters=shown,
        )
        answers: list[object] = hook(model=model)
        for answer in answers:
            if not isinstance(answer, FinalEdit):
                raise wrong_answer(hook, "a FinalEdit, or None", repr(answer))
            _check_edit(setup, state, answer.edit)
            adam = state.adam
            moments = replace(adam, exp_avg=dict(adam.exp_avg), exp_avg_sq=dict(adam.exp_avg_sq))
            changed = replace(state, moments=moments)
            _apply(setup, changed, answer.edit)
            state.tensors, state.moments = changed.tensors, changed.moments
            state.states = changed.states
            state.accept(answer.states, hook)
            yield answer


def put_in_order(setup: Setup, state: TrainState) -> None:
    """Sort the primitives in Morton order, so that neighbours in space are near in memory."""
    rows = in_order(state.tensors, setup.blocks, setup.backbone.positions)
    if rows is not None:
        _apply(setup, state, Edit(source=rows))


def _apply(setup: Setup, state: TrainState, edit: Edit) -> None:
    before = state.primitives(setup)
    state.settle(edit.values if edit.keeps_rows else None)
    for block in setup.blocks:
        if block.per_primitive:
            for name in block.tensors:
                for moments in (state.moments.exp_avg, state.moments.exp_avg_sq):
                    if name in moments:
                        moments[name] = apply_to_moment(edit, name, moments[name])
    state.tensors = apply_to_parameters(edit, setup.blocks, state.tensors)
    if edit.keeps_rows:
        return
    source, fresh = gather_indices(edit, before, setup.device)
    state.states = {
        name: _gathered(name, old, source, fresh, before) for name, old in state.states.items()
    }


def _gathered(name: str, old: PluginState, source: Tensor, fresh: Tensor, rows: int) -> PluginState:
    for key, tensor in old.per_primitive.items():
        if tensor.shape[:1] != (rows,):
            raise UserError(
                f"the state of plugin {name} does not match the Gaussians",
                where=f"per_primitive, {key}",
                expected=f"one row for each of the {rows} Gaussians before the edit",
                found=f"shape {list(tensor.shape)}",
                todo="repair the plugin (docs/hooks.md)",
            )
    return old.gathered(source, fresh)


def take_step(setup: Setup, state: TrainState) -> StepRecord:
    """Advance `state` by one training step.

    Raises:
        NonFiniteError: A loss or gradient is not finite. After this error, `state` must not be used
            any more.
    """
    regroup_if_due(setup, state)
    state.step += 1
    draw = _sample(setup, state)
    scales = scales_of(setup, state, draw)
    rendered, of_views = render_views(setup, state, draw, scales)
    rendered = replace(rendered, observed=observed_views(setup, state, rendered.records))
    context = _aggregate_context(setup, state, draw, rendered, of_views)
    aggregated = _aggregate(setup, state, context)
    of_step: TensorGradients = {}
    if setup.regularizes:
        add_regularization(setup, state, of_step)
    scale = setup.operator_scale.of(context)
    gradients = joined(aggregated.gradients, rendered.regular, of_step, scale)
    if setup.device.type == "cpu":
        # Skip this check on a GPU, because the check would wait for the GPU. On a GPU, the later
        # check of the parameters finds the error.
        _check_finite(state, rendered, gradients, of_views)
    state.laps.lap("aggregation")
    counted = aggregated.counts
    # Free the memory of the gradients, because an edit needs memory.
    del of_views, context, aggregated, of_step
    counts = _finish(setup, state, rendered, gradients, scale)
    primitives = state.primitives(setup)
    state.counters.peak_primitives = max(state.counters.peak_primitives, primitives)
    return StepRecord(
        step=state.step,
        views=draw.views,
        names=tuple(record.view.name for record in rendered.records),
        labels=draw.labels,
        losses=tuple(record.loss for record in rendered.records),
        primitives=primitives,
        # A checkpoint cannot contain NumPy integers.
        counts={name: int(count) for name, count in {**counted, **counts}.items()},
        train_seconds=state.clock.train,
        scales=scales,
    )


def sample_context(setup: Setup, state: TrainState, step: int) -> SampleContext:
    """Return the context that the sampler receives if `step` is the next step."""
    return SampleContext(
        **{**context_fields(setup, state, "sampler"), "step": step},
        views_per_step=setup.schedule.pace.at(step),
        groups=groups_of(setup, state),
        centers=setup.scene.centers,
        last=state.last,
    )


def check_largest_draw(setup: Setup) -> None:
    """Check that the sampler can draw the largest K of the run. Trial steps may use a smaller K.

    Raises:
        UserError: The sampler cannot draw the largest K.
    """
    blank = TrainState({}, AdamState(), make_streams(setup.config.seed))
    context = sample_context(setup, blank, 1)
    setup.sampler.sample(
        replace(context, views_per_step=max(setup.schedule.pace.counts)), EMPTY_STATE
    )


def _sample(setup: Setup, state: TrainState) -> ViewSample:
    context = sample_context(setup, state, state.step)
    answer = call_first_result(setup.hook.crossgrad_sample_views, context, SampleResult)
    state.accept(answer.states, setup.hook.crossgrad_sample_views)
    counts, photos = setup.sampler.counts(context.views_per_step), len(setup.train_views)
    views = answer.draw.views
    are_positions = all(isinstance(view, int | np.integer) and 0 <= view < photos for view in views)
    if are_positions and len(views) in counts:
        # A checkpoint cannot contain NumPy integers.
        views = tuple(map(int, views))
        return replace(answer.draw, views=views, labels=_labels(setup, state, answer.draw))
    raise UserError(
        "the sampler drew other views, or another number of views, than it announced",
        where=f"sampler {setup.selection.names['sampler']}, step {state.step}",
        expected=f"{listed(map(str, sorted(counts)))} views, positions from 0 to {photos - 1}",
        found=f"{len(views)} views: {views}",
        todo="choose another --sampler, or list every possible number of views in the "
        "plugin's `counts`",
    )


def _labels(setup: Setup, state: TrainState, draw: ViewSample) -> tuple[str, ...] | None:
    """Return the labels of a draw as a tuple. A plugin may return a list or an array."""
    labels: object = draw.labels
    if labels is None:
        return None
    given = tuple(labels) if isinstance(labels, tuple | list | np.ndarray) else ()
    if len(given) == len(draw.views) and all(isinstance(label, str) for label in given):
        return tuple(map(str, given))
    raise UserError(
        "the sampler returned a wrong number of labels",
        where=f"sampler {setup.selection.names['sampler']}, step {state.step}",
        expected=f"{len(draw.views)} strings, or None for no labels",
        found=repr(labels),
        todo="choose another --sampler, or repair the plugin",
    )


def _aggregate_context(
    setup: Setup, state: TrainState, draw: ViewSample, rendered: Rendered, of_views: Gradients
) -> AggregateContext:
    return AggregateContext(
        **context_fields(setup, state, "operator"),
        gradients=of_views,
        losses=np.array([record.loss for record in rendered.records]),
        labels=draw.labels,
        distances=setup.scene.distances[list(draw.views)],
        reference_distance=float(np.median(setup.scene.distances)),
        blocks=setup.trained_blocks,
        scales=tuple(record.scale for record in rendered.records),
    )


def _aggregate(setup: Setup, state: TrainState, context: AggregateContext) -> AggregateResult:
    answer = call_first_result(setup.hook.crossgrad_aggregate_gradients, context, AggregateResult)
    state.accept(answer.states, setup.hook.crossgrad_aggregate_gradients)
    wanted = {name: state.tensors[name] for b in setup.trained_blocks for name in b.tensors}
    if misfit := _misfit(answer, wanted):
        raise UserError(
            "the aggregated gradients do not match the parameters",
            where=f"operator {setup.selection.names['operator']} or a plugin that wraps it, "
            f"step {state.step}",
            expected="for each tensor, a gradient of its shape and type; None if the tensor does "
            "not learn",
            found=misfit,
            todo="choose another --operator, or repair the plugin (docs/hooks.md)",
        )
    state.counters.dropped += int(answer.counts.get("dropped", 0))
    return answer


def _misfit(answer: AggregateResult, wanted: Mapping[str, Tensor]) -> str:
    """Return why a result does not match the trained tensors.

    The text is empty for a matching result.
    """
    for mapping in (answer.gradients, answer.counts):
        if not isinstance(mapping, Mapping):
            return f"{type(mapping).__name__}, not a mapping of names"
    if strange := wanted.keys() ^ answer.gradients.keys():
        return listed(f"{n} is {'missing' if n in wanted else 'unknown'}" for n in strange)
    for name, gradient in answer.gradients.items():
        if gradient is not None and not isinstance(gradient, Tensor):
            return f"{name}: {type(gradient).__name__}"
        shape, dtype = wanted[name].shape, wanted[name].dtype
        if gradient is not None and (gradient.shape != shape or gradient.dtype != dtype):
            return (
                f"{name}: {list(gradient.shape)} of {gradient.dtype}, not {list(shape)} of {dtype}"
            )
    return ""


def _finish(
    setup: Setup, state: TrainState, rendered: Rendered, gradients: TensorGradients, scale: Scale
) -> Mapping[str, int]:
    """Run the optimizer, density control and later hooks in the order that `step_order` sets.

    The dictionary `gradients` is emptied after use.
    """
    state.touched = True
    if setup.numbers.step_order == "optimize-first":
        _optimize(setup, state, rendered, gradients, scale)
        gradients.clear()
        if setup.schedule.densifies(state.step):
            # Finish the background updates first. The gradients of running updates use memory that
            # an edit needs.
            state.late.finish()
        edit, edited = _densify(setup, state, rendered)
    else:
        edit, edited = _densify(setup, state, rendered)
        # As in the published 3DGS code, an edit comes before the optimizer and replaces tensors.
        # Gradients of replaced tensors are not used.
        gone = set(gradients) if edited else set(edit.values)
        if state.step < setup.schedule.total:
            left = {name: g for name, g in gradients.items() if name not in gone}
            _optimize(setup, state, rendered, left, scale)
    if setup.acts_after_step:
        edited |= _after_step(setup, state, edited=edited)
    if edited:
        put_in_order(setup, state)
    if setup.follows_steps:
        _step_done(setup, state, edited=edited or bool(edit.values))
    return edit.counts


def _optimize(
    setup: Setup, state: TrainState, rendered: Rendered, gradients: TensorGradients, scale: Scale
) -> None:
    progress = setup.schedule.progress(state.step)
    take_photo_step(setup, state, rendered.photos, progress)
    rates, rule = rates_at(setup, state.step), rule_at(setup, state.step)
    # A regularization term may give a gradient to a tensor that is not updated in this step.
    resting = setup.resting(state.step)
    learning = {name: coalesced(g) for name, g in gradients.items() if name not in resting}
    waiting = set(setup.sparse_rows.values())
    sparse_rows = {
        n: g for n, g in learning.items() if g is not None and g.is_sparse and n in waiting
    }
    whole = {name: dense(g) for name, g in learning.items() if name not in sparse_rows}
    state.settle(name for name, g in whole.items() if g is not None)
    _take_adam_step(setup, state, whole, rates, rule, scale)
    _after_optimizer(setup, state)
    for name, gradient in sparse_rows.items():
        param, to_sum = state.tensors[name], scale.to_sum[name]
        step = one_more(name, param, state.moments, rates[name], rule, to_sum)
        state.late.step(name, param, gradient, state.moments, step)
    state.laps.lap("optimizer")


def _take_adam_step(
    setup: Setup,
    state: TrainState,
    gradients: TensorGradients,
    rates: Mapping[str, float],
    rule: AdamRule,
    scale: Scale,
) -> None:
    """Take Adam's step of whole tensors.

    With `per-axis`, position steps are scaled along the axes of each Gaussian.
    """
    tensors, names = state.tensors, axes_of(setup)
    if names is None or gradients.get(names[0]) is None:
        adam_step(tensors, gradients, state.moments, rates, rule, scale.to_sum)
        return
    name, *axes = names
    steps = torch.empty_like(tensors[name])
    moved = {**tensors, name: steps}
    adam_step(moved, gradients, state.moments, rates, rule, scale.to_sum, from_zero={name})
    step_along_axes(tensors[name], steps, *(tensors[axis] for axis in axes))


def _densify(setup: Setup, state: TrainState, rendered: Rendered) -> tuple[Edit, bool]:
    context = DensifyContext(
        **context_fields(setup, state, "densifier"),
        parameters=state.current,
        backbone=setup.backbone,
        rasterizer=setup.rasterizer,
        views=rendered.observed,
        share=len(rendered.observed) / len(rendered.records),
        means_lr=means_rate_at(setup, state.step),
        room=max_new_gaussians(setup, state, rendered),
        render=RenderCallback(setup, state, counted=True),
    )
    answer = call_first_result(setup.hook.crossgrad_densify, context, DensifyResult)
    state.accept(answer.states, setup.hook.crossgrad_densify)
    edited = apply_edit(setup, state, answer.edit)
    state.laps.lap("density_control")
    return answer.edit, edited


def _after_optimizer(setup: Setup, state: TrainState) -> None:
    for hook in setup.optimizer_hooks:
        context = _after_context(setup, state, edited=False)
        for answer in call_all(hook, context, DensifyResult):
            if not answer.edit.keeps_rows:
                raise wrong_answer(hook, "an edit of values", "an edit of the set of primitives")
            state.accept(answer.states, hook)
            apply_edit(setup, state, answer.edit)


def _after_step(setup: Setup, state: TrainState, *, edited: bool) -> bool:
    """Run the hooks after the step. Return True if primitives were added, removed or reordered."""
    changed = False
    context = _after_context(setup, state, edited=edited)
    for answer in call_all(setup.hook.crossgrad_after_step, context, DensifyResult):
        state.accept(answer.states, setup.hook.crossgrad_after_step)
        changed |= apply_edit(setup, state, answer.edit)
    return changed


def _step_done(setup: Setup, state: TrainState, *, edited: bool) -> None:
    context = _after_context(setup, state, edited=edited)
    for answer in call_all(setup.hook.crossgrad_step_done, context, Answer):
        state.accept(answer.states, setup.hook.crossgrad_step_done)


def _after_context(setup: Setup, state: TrainState, *, edited: bool) -> AfterStepContext:
    return AfterStepContext(
        **context_fields(setup, state, "after_step"),
        parameters=state.current,
        backbone=setup.backbone,
        means_lr=means_rate_at(setup, state.step),
        edited=edited,
    )


def _check_finite(
    state: TrainState, rendered: Rendered, gradients: TensorGradients, of_views: Gradients
) -> None:
    for name, gradient in gradients.items():
        if gradient is None or of_views.is_judged(name, gradient):
            continue
        if not is_finite(gradient):
            views = tuple(record.view.name for record in rendered.records)
            raise NonFiniteError(state.step, views, f"the gradient of block {name}")

"""Render the K views of a step and run their backward passes."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from math import inf, isfinite, nan
from numbers import Real
from time import perf_counter, thread_time
from typing import Any

import numpy as np
import torch
from pluggy import HookCaller
from torch import Tensor

from crossgrad_core.contract.blocks import Parameters
from crossgrad_core.contract.component import answered
from crossgrad_core.contract.contexts import (
    PixelContext,
    RegularizeContext,
    RegularizeResult,
    RequestedRender,
    ScaleContext,
    ScaleResult,
    ViewRecord,
    ViewSample,
)
from crossgrad_core.contract.gaussians import Gaussians, OnDemand, Render
from crossgrad_core.contract.gradients import Gradients
from crossgrad_core.contract.scene import Camera, View
from crossgrad_core.contract.slots.rule import GaussiansContext
from crossgrad_core.errors import UserError
from crossgrad_core.gradients.columns import is_native
from crossgrad_core.gradients.deferred import DeferredSums
from crossgrad_core.gradients.separate import DenseGradients
from crossgrad_core.gradients.sparse_rows import coalesced, dense
from crossgrad_core.gradients.summed import SummedGradients
from crossgrad_core.registry.manager import call_all, call_first_result
from crossgrad_core.training.per_image_params import Leaves, apply, leaves_of
from crossgrad_core.training.rules import view_gaussians
from crossgrad_core.training.scaled_photos import Pair, on_device
from crossgrad_core.training.setup import Scale, Setup
from crossgrad_core.training.state import NonFiniteError, TrainState
from crossgrad_core.training.strided_rendering import (
    as_in_full,
    camera_of,
    corner_of,
    pixels_of,
    stride_of,
)
from crossgrad_core.wording import listed


@dataclass(frozen=True, eq=False)
class Target:
    """The camera that renders a view, and the photo with which the render is compared.

    Attributes:
        camera: The camera for the render.
        scale: Side length of the render, divided by the side length of the training photo.
        photo: [H, W, 3] uint8, in the size of the render.
        mask: [H, W] bool, True for valid pixels; None if all pixels are valid.
        stride: n, if the render contains one pixel of each n x n block of the photo; otherwise 1.
    """

    camera: Camera
    scale: float
    photo: Tensor
    mask: Tensor | None
    stride: int = 1


def target_at(setup: Setup, state: TrainState, index: int, scale: float, slot: int = 0) -> Target:
    """Return the camera and the photo of a training view at a scale in (0, 1].

    Args:
        setup: Setup of the run.
        state: The training state.
        index: Position of the view in the training views.
        scale: Side length of the render, divided by the side length of the training photo.
        slot: Position of the view in the step. With a stride, `slot` and the step number choose the
            rendered pixels.
    """
    view = setup.train_views[index]
    stride, camera = _stride_at(setup, view, scale), photo_camera(setup, view, scale)
    pair = setup.scaled_photos.get(view, camera, partial(_decoded, state))
    if stride > 1:
        corner = corner_of(state.step, slot, stride)
        camera, pair = camera_of(camera, stride, corner), pixels_of(pair, stride, corner)
    return Target(camera, scale, *pair, stride)


def photo_camera(setup: Setup, view: View, scale: float) -> Camera:
    """Return the camera of the photo from which the pixels of a view are taken at this scale."""
    return view.camera if _stride_at(setup, view, scale) > 1 else camera_at(view.camera, scale)


def _stride_at(setup: Setup, view: View, scale: float) -> int:
    return stride_of(scale, view.camera) if setup.selection.resolution.strided else 1


def weights_of(setup: Setup, state: TrainState, index: int, target: Target) -> Tensor | None:
    """Return [H, W], the weight of each pixel in the loss; None if all weights are equal."""
    if not setup.weighs:
        return None
    context = PixelContext(
        **context_fields(setup, state, "regularize"),
        index=index,
        view=setup.train_views[index],
        camera=target.camera,
        scale=target.scale,
        target=target.photo,
        mask=target.mask,
    )
    hook = setup.hook.crossgrad_pixel_weights
    factors: list[object] = hook(context=context)
    fitting = [_fitting(weights, context, hook) for weights in factors]
    return reduce(torch.mul, fitting) if fitting else None


def _fitting(weights: object, context: PixelContext, hook: HookCaller) -> Tensor:
    """Return the pixel weights of a plugin after a check.

    On a GPU, only shape and type are checked, because other checks would wait for the GPU.
    """
    shape = context.target.shape[:2]
    description, least = type(weights).__name__, ""
    if isinstance(weights, Tensor):
        description = f"{list(weights.shape)} of {weights.dtype}"
        if weights.shape == shape and weights.is_floating_point():
            if not weights.is_cpu or bool(((weights >= 0) & (weights < inf)).all()):
                return weights
            least = f", the least {float(weights.min()):g}"
    who = listed(implementation.plugin_name for implementation in hook.get_hookimpls())
    raise UserError(
        "a plugin returned invalid pixel weights",
        where=f"hook crossgrad_pixel_weights of {who}, photo {context.view.name}",
        expected=f"finite floating-point numbers of at least 0, with shape {list(shape)}",
        found=f"{description}{least}",
        todo="repair the plugin, or run without it",
    )


def camera_at(camera: Camera, scale: float) -> Camera:
    """Return the camera resized by `scale`, with a whole number of pixels on each side."""
    width = max(1, round(camera.width * scale))
    height = max(1, round(camera.height * scale))
    if (width, height) == (camera.width, camera.height):
        return camera
    return camera.resized(width, height)


def context_fields(setup: Setup, state: TrainState, stream: str) -> dict[str, Any]:
    """Return the fields that all hook contexts of a step share."""
    return {
        "step": state.step,
        "schedule": setup.schedule,
        "scene": setup.scene,
        "states": state.states,
        "rng": state.rngs[stream],
        "photo": partial(photo_of, setup, state),
    }


def photo_of(setup: Setup, state: TrainState, view: View) -> Pair:
    """Return the photo and the mask of a view on the run's device.

    Decoding time counts as loading.
    """
    return on_device(_decoded(state, view), setup.device)


def _decoded(state: TrainState, view: View) -> Pair:
    """Return the decoded photo and the mask of a view in host memory."""
    start, cpu = perf_counter(), thread_time()
    image, mask = view.photo.image(), view.photo.mask()
    seconds = perf_counter() - start
    state.clock.load += seconds
    state.laps.leave_out(seconds, thread_time() - cpu)
    return image, mask


def background_of(setup: Setup, state: TrainState) -> Tensor:
    """Return the background [3] RGB of the next training view."""
    if setup.config.background == "random":
        rgb = state.rngs["background"].random(3).astype(np.float32)
        return torch.from_numpy(rgb).to(setup.device, non_blocking=True)
    return eval_background(setup)


def eval_background(setup: Setup) -> Tensor:
    """Return the background [3] RGB for evaluation. A random background is replaced by black."""
    name = setup.config.background
    named = {"black": (0.0, 0.0, 0.0), "random": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
    rgb = named[name] if name in named else tuple(float(level) for level in name.split(","))
    return torch.tensor(rgb, dtype=torch.float32).to(setup.device, non_blocking=True)


#: Tensor name -> gradient, or None without a gradient.
TensorGradients = dict[str, Tensor | None]


def add_regularization(
    setup: Setup,
    state: TrainState,
    into: TensorGradients,
    gaussians: Gaussians | None = None,
    view: View | None = None,
) -> None:
    """Add the gradients of regularization terms to `into`.

    The terms belong to `view`. If `view` is None, the terms belong to the whole step.
    """
    context = RegularizeContext(
        **context_fields(setup, state, "regularize"),
        parameters=state.current,
        backbone=setup.backbone,
        gaussians=gaussians,
        view=view,
    )
    for answer in call_all(setup.hook.crossgrad_regularize, context, RegularizeResult):
        state.accept(answer.states, setup.hook.crossgrad_regularize)
        _add(into, _gradients_of(answer.loss, state.tensors, keep=gaussians is not None))


def _gradients_of(loss: Tensor, parameters: Mapping[str, Tensor], *, keep: bool) -> TensorGradients:
    wanted = {name: t for name, t in parameters.items() if t.requires_grad}
    if not loss.requires_grad:
        return {}
    gradients = torch.autograd.grad(
        loss, list(wanted.values()), retain_graph=keep, allow_unused=True
    )
    return dict(zip(wanted, gradients, strict=True))


def _add(into: TensorGradients, more: Mapping[str, Tensor | None]) -> None:
    for name, gradient in more.items():
        if gradient is not None:
            have = dense(into.get(name))
            into[name] = gradient if have is None else have + gradient


def joined(
    gradients: Mapping[str, Tensor | None],
    of_views: TensorGradients,
    of_step: TensorGradients,
    scale: Scale,
) -> TensorGradients:
    """Return the aggregated gradients plus the gradients of the regularization terms.

    The terms are multiplied by the operator's factor c(K). The weight of the terms relative to the
    photometric loss therefore does not depend on the operator. The factor is c(K) for terms of the
    whole step, and c(K) / K for terms of a view.

    Args:
        gradients: The aggregated gradients of the photometric losses.
        of_views: Sum of the gradients of all terms of single views.
        of_step: Sum of the gradients of all terms of the whole step.
        scale: The scale of the operator's result for K equal gradients.
    """
    regular = _times(of_views, scale.per_view)
    _add(regular, _times(of_step, scale.per_step))
    result = dict(gradients)
    _add(result, regular)
    return result


def _times(gradients: TensorGradients, factors: Mapping[str, float]) -> TensorGradients:
    """Return the gradients, multiplied by the factors of their tensors.

    Gradients with a factor of 0 are left out.
    """
    return {
        name: gradient if factors[name] == 1.0 else gradient * factors[name]
        for name, gradient in gradients.items()
        if gradient is not None and factors[name]
    }


@dataclass(frozen=True, eq=False)
class Rendered:
    """The views of a step after their backward passes.

    Attributes:
        records: One record for each view.
        regular: Sum of the gradients of the views' regularization terms.
        photos: For each view: its position in the training views, and the exposure parameters of
            its photo with their gradients.
        observed: The records that density control receives.
    """

    records: tuple[ViewRecord, ...]
    regular: TensorGradients
    photos: tuple[tuple[int, Leaves], ...]
    observed: tuple[ViewRecord, ...] = ()


@dataclass(frozen=True, eq=False)
class _Prepared:
    """A view whose photo and Gaussians are ready to be rendered."""

    slot: int
    target: Target
    background: Tensor
    gaussians: Gaussians


@dataclass(frozen=True, eq=False)
class _Drawn:
    """A rendered view with its autograd graph. The record does not yet contain the loss."""

    record: ViewRecord
    gaussians: Gaussians
    loss: Tensor
    leaves: Leaves


def scales_of(setup: Setup, state: TrainState, draw: ViewSample) -> tuple[float, ...]:
    """Return the image scales at which the views of `draw` are rendered."""
    context = ScaleContext(**context_fields(setup, state, "resolution"), draw=draw, last=state.last)
    answer = call_first_result(setup.hook.crossgrad_choose_scales, context, ScaleResult)
    state.accept(answer.states, setup.hook.crossgrad_choose_scales)
    scales = answer.scales
    if len(scales) == len(draw.views) and all(
        isinstance(scale, Real) and 0.0 < scale <= 1.0 for scale in scales
    ):
        return tuple(map(float, scales))  # A checkpoint cannot contain NumPy numbers.
    raise UserError(
        "the resolution returned a wrong scale for a view",
        where=f"resolution {setup.selection.names['resolution']}, step {state.step}",
        expected=f"{len(draw.views)} numbers, each above 0 and at most 1",
        found=repr(scales),
        todo="choose another --resolution, or repair the plugin",
    )


def render_views(
    setup: Setup, state: TrainState, draw: ViewSample, scales: Sequence[float]
) -> tuple[Rendered, Gradients]:
    """Render the views of `draw`. Return the renders and their gradients, separate or summed.

    Raises:
        NonFiniteError: The loss of a view is not finite.
    """
    regular: TensorGradients = {}
    if setup.joint:
        return _render_jointly(setup, state, draw, scales, regular)
    records, losses, per_view, photos = [], [], [], []
    total = _sums(setup, len(draw.views))
    way = _together if setup.rasterizer.batched and len(draw.views) > 1 else _one_by_one
    for drawn, gradients in way(setup, state, draw, scales, regular):
        records.append(drawn.record)
        losses.append(drawn.loss.detach())
        photos.append((drawn.record.index, drawn.leaves))
        if setup.separate:
            per_view.append(gradients)
        else:
            total.add(gradients)
        state.laps.lap("backward")
    with_losses = _with_losses(state, records, losses)
    state.counters.backward_passes += len(records)
    if not setup.separate:
        return Rendered(with_losses, regular, tuple(photos)), total
    # The operator may overwrite the separate gradients, unless a plugin reads the gradients later.
    apart = DenseGradients(per_view, setup.trained_blocks, overwrite=not setup.watchers)
    return Rendered(with_losses, regular, tuple(photos)), apart


def _sums(setup: Setup, views: int) -> SummedGradients | DeferredSums:
    """Return an empty sum to which the gradients of `views` views are added."""
    if setup.device.type == "cpu":
        return SummedGradients.empty(setup.trained_blocks, views)
    return DeferredSums(setup.trained_blocks, views)


def _one_by_one(
    setup: Setup,
    state: TrainState,
    draw: ViewSample,
    scales: Sequence[float],
    regular: TensorGradients,
) -> Iterator[tuple[_Drawn, TensorGradients]]:
    """Yield each view with its gradients.

    Each view is rendered and its backward pass is run before the next view.
    """
    _clear(state.tensors)
    for slot in range(len(draw.views)):
        drawn = _draw_view(setup, state, draw, slot, scales[slot])
        _regularize_view(setup, state, drawn, regular)
        state.laps.lap("loss")
        _backward(drawn.loss)
        yield drawn, _take(state.tensors)


def _together(
    setup: Setup,
    state: TrainState,
    draw: ViewSample,
    scales: Sequence[float],
    regular: TensorGradients,
) -> Iterator[tuple[_Drawn, TensorGradients]]:
    """Yield each view with its gradients.

    All views share one call of the rasterizer and one backward pass.

    The shared backward pass ends at copies of each view's decoded Gaussians. For each view, a
    second backward pass continues from these copies to the parameters.
    """
    _clear(state.tensors)
    slots = range(len(draw.views))
    prepared = [_prepare(setup, state, draw, slot, scales[slot]) for slot in slots]
    copies = [view.gaussians.mapped(_leaf) for view in prepared]
    renders = setup.rasterizer.render_views(
        [(copy, view.target.camera) for copy, view in zip(copies, prepared, strict=True)],
        [view.background for view in prepared],
        _outputs(setup, state),
    )
    state.laps.lap("render")
    pairs = zip(prepared, renders, strict=True)
    drawn = [_compare(setup, state, draw, view, render) for view, render in pairs]
    for drawn_view in drawn:
        _regularize_view(setup, state, drawn_view, regular)
    state.laps.lap("loss")
    _backward(torch.stack([drawn_view.loss for drawn_view in drawn]).sum())
    for drawn_view, copy in zip(drawn, copies, strict=True):
        _pass_back(drawn_view.gaussians, copy)
        yield drawn_view, _take(state.tensors)


def _leaf(tensor: Tensor) -> Tensor:
    return tensor.detach().requires_grad_(tensor.requires_grad)


def _pass_back(decoded: Gaussians, copy: Gaussians) -> None:
    """Propagate the gradients of the copied Gaussians to the parameters."""
    # If a tensor requires no gradient, its copy has no gradient.
    pairs = [(t, c.grad) for t, c in zip(decoded.floats(), copy.floats(), strict=True)]
    given = [(tensor, gradient) for tensor, gradient in pairs if gradient is not None]
    torch.autograd.backward([t for t, _ in given], [g for _, g in given])


def _with_losses(
    state: TrainState, records: Sequence[ViewRecord], losses: Sequence[Tensor]
) -> tuple[ViewRecord, ...]:
    """Return the records with their losses.

    All losses are read at once, so that the CPU waits for the GPU only once.

    Raises:
        NonFiniteError: The loss of a view is not finite.
    """
    values = torch.stack(list(losses)).tolist()
    for record, value in zip(records, values, strict=True):
        if not isfinite(value):
            raise NonFiniteError(state.step, (record.view.name,), "the photometric loss")
    return tuple(replace(r, loss=value) for r, value in zip(records, values, strict=True))


def _render_jointly(
    setup: Setup,
    state: TrainState,
    draw: ViewSample,
    scales: Sequence[float],
    regular: TensorGradients,
) -> tuple[Rendered, Gradients]:
    """Run one backward pass through the sum of all losses.

    The autograd graphs of all views exist in parallel.
    """
    _clear(state.tensors)
    drawn = [_draw_view(setup, state, draw, slot, scale) for slot, scale in enumerate(scales)]
    losses = [view.loss.detach() for view in drawn]
    records = _with_losses(state, [view.record for view in drawn], losses)
    for view in drawn:
        _regularize_view(setup, state, view, regular)
    state.laps.lap("loss")
    _backward(torch.stack([view.loss for view in drawn]).sum())
    state.laps.lap("backward")
    state.counters.backward_passes += 1
    total = SummedGradients(_take(state.tensors), setup.trained_blocks, len(records))
    photos = tuple((view.record.index, view.leaves) for view in drawn)
    return Rendered(records, regular, photos), total


def _prepare(
    setup: Setup, state: TrainState, draw: ViewSample, slot: int, scale: float
) -> _Prepared:
    """Return the photo and the decoded Gaussians of one view of `draw`."""
    target = target_at(setup, state, draw.views[slot], scale, slot)
    background = background_of(setup, state)
    state.laps.lap("photos")
    gaussians = as_in_full(_seen(setup, state, target.camera), setup.rasterizer, target.stride)
    if setup.gaussians_hooks:
        context = GaussiansContext(
            **context_fields(setup, state, "regularize"),
            view=setup.train_views[draw.views[slot]],
            gaussians=gaussians,
            rngs=state.rngs,
        )
        gaussians = view_gaussians(setup, state, context)
    state.laps.lap("decode")
    return _Prepared(slot, target, background, gaussians)


def _outputs(setup: Setup, state: TrainState) -> frozenset[str]:
    """Return the statistics that the densifier needs; empty after the end of density control."""
    return setup.densifier.needs if setup.schedule.collects(state.step) else frozenset()


def _draw_view(
    setup: Setup, state: TrainState, draw: ViewSample, slot: int, scale: float
) -> _Drawn:
    view, wanted = _prepare(setup, state, draw, slot, scale), _outputs(setup, state)
    camera = view.target.camera
    render = setup.rasterizer.render(view.gaussians, camera, view.background, wanted)
    state.laps.lap("render")
    return _compare(setup, state, draw, view, render)


def _compare(
    setup: Setup, state: TrainState, draw: ViewSample, view: _Prepared, render: Render
) -> _Drawn:
    """Compare the render of a view with its photo. Return the loss and the record of the view."""
    index, target = draw.views[view.slot], view.target
    leaves = leaves_of(setup, state, index)
    image = setup.exposure.apply(render.image, leaves)
    weights = weights_of(setup, state, index, target)
    loss = setup.loss.loss(image, target.photo, target.mask, weights)
    state.counters.views += 1
    record = ViewRecord(
        index=index,
        view=setup.train_views[index],
        label=draw.labels[view.slot] if draw.labels is not None else None,
        loss=nan,
        gaussians=view.gaussians.detached().whole(),
        screen=render.screen,
        background=view.background,
        camera=target.camera,
        scale=target.scale,
        image=image.detach(),
        photo=target.photo,
        mask=target.mask,
    )
    return _Drawn(record, view.gaussians, loss, leaves)


def _seen(setup: Setup, state: TrainState, camera: Camera) -> Gaussians:
    """Return the decoded Gaussians of a view.

    Rows with deferred steps are updated when they are rendered.
    """
    phase = setup.phase(state.step, training=True)
    tensors = _learning(setup, state)
    answer = setup.backbone.decode(tensors, camera, phase)
    gaussians = answered(answer, Gaussians, setup.backbone, "decode")
    names = {f: n for f, n in setup.sparse_rows.items() if getattr(gaussians, f) is tensors[n]}
    if names.keys() != {f for f in setup.sparse_rows if getattr(gaussians, f) is not None}:
        # The decoded Gaussians do not share a tensor with the parameters, so `decode` may have read
        # rows with deferred steps.
        state.settle()
        return setup.backbone.decode(tensors, camera, phase)
    if not names or not is_native([state.tensors[name] for name in names.values()]):
        return gaussians

    def bring(rows: Tensor | None) -> None:
        for name in names.values():
            state.late.catch_up(name, state.tensors[name], state.moments, rows)

    return replace(gaussians, on_demand=OnDemand(frozenset(names), bring))


def _learning(setup: Setup, state: TrainState) -> Parameters:
    """Return the parameters in memory. Tensors that are not updated in this step are detached."""
    resting = setup.resting(state.step)
    if not resting:
        return state.tensors
    return {name: t.detach() if name in resting else t for name, t in state.tensors.items()}


def observe_view(setup: Setup, state: TrainState, draw: ViewSample, scale: float) -> ViewRecord:
    """Render the single view of `draw` to collect its statistics.

    The gradients of this view are discarded.

    Raises:
        NonFiniteError: The loss of the view is not finite.
    """
    drawn = _draw_view(setup, state, draw, 0, scale)
    state.laps.lap("loss")
    _backward(drawn.loss)
    _clear(state.tensors)
    record = _with_losses(state, [drawn.record], [drawn.loss.detach()])[0]
    state.counters.backward_passes += 1
    state.laps.lap("backward")
    return record


def _regularize_view(setup: Setup, state: TrainState, drawn: _Drawn, into: TensorGradients) -> None:
    if setup.regularizes:
        add_regularization(setup, state, into, drawn.gaussians.whole(), drawn.record.view)


def _backward(loss: Tensor) -> None:
    # If no Gaussian is visible, the image is constant and has no gradients. A view without visible
    # Gaussians is not an error.
    if loss.requires_grad:
        loss.backward()  # type: ignore[no-untyped-call]


def _clear(parameters: Mapping[str, Tensor]) -> None:
    for tensor in parameters.values():
        tensor.grad = None


def _take(parameters: Mapping[str, Tensor]) -> TensorGradients:
    taken = {name: coalesced(t.grad) for name, t in parameters.items() if t.requires_grad}
    _clear(parameters)
    return taken


@dataclass(frozen=True, eq=False)
class RenderCallback:
    """A function that renders training views for plugins, with the present parameters.

    Attributes:
        setup: Setup of the run.
        state: The training state.
        counted: True if the renders of this function are included in the number of rendered views.
    """

    setup: Setup
    state: TrainState
    counted: bool

    def __call__(
        self,
        view: int,
        scale: float = 1.0,
        outputs: frozenset[str] = frozenset(),
        background: Tensor | None = None,
    ) -> RequestedRender:
        """Return the rendered view, as described in `RenderOnRequest`.

        Raises:
            UserError: The view does not exist, or the scale is not in (0, 1].
        """
        setup, state = self.setup, self.state
        _check(setup, view, scale)
        state.counters.views += self.counted
        target = target_at(setup, state, view, scale)
        gaussians = setup.backbone.decode(
            state.parameters, target.camera, setup.phase(state.step, training=True)
        )
        gaussians = as_in_full(gaussians, setup.rasterizer, target.stride)
        if background is None:
            background = eval_background(setup)
        render = setup.rasterizer.render(gaussians, target.camera, background, outputs)
        image = apply(setup, state, setup.train_views[view], render.image)

        def measure() -> Tensor:
            weights = weights_of(setup, state, view, target)
            return setup.loss.loss(image, target.photo, target.mask, weights)

        return RequestedRender(
            view=setup.train_views[view],
            camera=target.camera,
            scale=scale,
            gaussians=gaussians,
            render=render,
            screen=render.screen,
            image=image,
            photo=target.photo,
            mask=target.mask,
            measure=measure,
        )


def _check(setup: Setup, view: int, scale: float) -> None:
    count = len(setup.train_views)
    if 0 <= view < count and 0.0 < scale <= 1.0:
        return
    raise UserError(
        "a plugin requested a render that is not possible",
        expected=f"a training view from 0 to {count - 1}, and a scale above 0 and at most 1",
        found=f"view {view}, scale {scale}",
        todo="repair the plugin that requests the render",
    )

"""Rendering the K views of a step and running their backward passes."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from math import isfinite
from time import perf_counter

import numpy as np
import torch
from torch import Tensor

from crossgrad_core.contract.contexts import Draw, Model, RegularizeContext, ViewRecord
from crossgrad_core.contract.gaussians import Gaussians, Render
from crossgrad_core.contract.gradients import Gradients
from crossgrad_core.contract.scene import View
from crossgrad_core.gradients.separate import DenseGradients
from crossgrad_core.gradients.summed import SummedGradients
from crossgrad_core.training.failure import NonFiniteError
from crossgrad_core.training.loss.loss import photometric_loss
from crossgrad_core.training.operator_scale import Scale
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState

#: Tensor name -> gradient or None.
TensorGradients = dict[str, Tensor | None]


@dataclass(frozen=True, eq=False)
class Rendered:
    """The views of one step after their backward passes.

    Attributes:
        records: One record per view.
        gradients: Their gradients, apart or summed up as the operator needs them.
        regular: Sum of the gradients of the views' regularisation terms, apart from the above.
    """

    records: tuple[ViewRecord, ...]
    gradients: Gradients
    regular: TensorGradients


@dataclass(frozen=True, eq=False)
class _Drawn:
    """A view with its graph still alive."""

    record: ViewRecord
    gaussians: Gaussians
    render: Render
    loss: Tensor


def render_views(setup: Setup, state: TrainState, draw: Draw) -> Rendered:
    """Renders the views of `draw` and gathers their gradients.

    Raises:
        NonFiniteError: A loss is not finite.
    """
    regular: TensorGradients = {}
    if setup.joint:
        return _render_jointly(setup, state, draw, regular)
    records, per_view = [], []
    total = SummedGradients.empty(setup.trained_blocks, len(draw.views))
    _clear(state.parameters)
    for slot in range(len(draw.views)):
        drawn = _draw_view(setup, state, draw, slot)
        _regularize_view(setup, state, drawn, regular)
        _backward(drawn.loss)
        records.append(drawn.record)
        if setup.separate:
            per_view.append(_take(state.parameters))
        else:
            total.add(_take(state.parameters))
    state.counters.backward_passes += len(records)
    if not setup.separate:
        return Rendered(tuple(records), total, regular)
    # Nobody looks at single views after they are combined, unless a plugin says so.
    apart = DenseGradients(per_view, setup.trained_blocks, overwrite=not setup.watchers)
    return Rendered(tuple(records), apart, regular)


def _render_jointly(
    setup: Setup, state: TrainState, draw: Draw, regular: TensorGradients
) -> Rendered:
    """One backward pass through the sum of the losses (kept for comparison; all graphs alive)."""
    _clear(state.parameters)
    drawn = [_draw_view(setup, state, draw, slot) for slot in range(len(draw.views))]
    for view in drawn:
        _regularize_view(setup, state, view, regular)
    _backward(torch.stack([view.loss for view in drawn]).sum())
    state.counters.backward_passes += 1
    records = tuple(view.record for view in drawn)
    total = SummedGradients(_take(state.parameters), setup.trained_blocks, len(records))
    return Rendered(records, total, regular)


def _draw_view(setup: Setup, state: TrainState, draw: Draw, slot: int) -> _Drawn:
    index = draw.views[slot]
    view = setup.train_views[index]
    target, mask = photo_of(setup, state, view)
    background = background_of(setup, state)
    gaussians = setup.backbone.decode(
        state.parameters, view.camera, setup.phase(state.step, training=True)
    )
    # Nobody reads the optional statistics once density control is over, and some cost much.
    wanted = setup.densifier.needs if setup.schedule.collects(state.step) else frozenset()
    render = setup.rasterizer.render(gaussians, view.camera, background, wanted)
    loss = photometric_loss(render.image, target, mask, setup.config.ssim_weight)
    state.counters.views += 1
    value = float(loss.detach())
    if not isfinite(value):
        raise NonFiniteError(state.step, (view.name,), "the photometric loss")
    record = ViewRecord(
        index=index,
        view=view,
        label=draw.labels[slot] if draw.labels is not None else None,
        loss=value,
        gaussians=gaussians.detached(),
        screen=render.screen,
        background=background,
    )
    return _Drawn(record, gaussians, render, loss)


def photo_of(setup: Setup, state: TrainState, view: View) -> tuple[Tensor, Tensor | None]:
    """The decoded photo and mask of a view on the run's device; decoding counts as loading."""
    start = perf_counter()
    image, mask = view.photo.image(), view.photo.mask()
    image = image.to(setup.device)
    mask = None if mask is None else mask.to(setup.device)
    state.clock.load += perf_counter() - start
    return image, mask


def background_of(setup: Setup, state: TrainState) -> Tensor:
    """[3] RGB that the next training view is drawn over."""
    if setup.config.background == "random":
        rgb = state.rngs["background"].random(3).astype(np.float32)
        return torch.from_numpy(rgb).to(setup.device)
    return eval_background(setup)


def eval_background(setup: Setup) -> Tensor:
    """[3] RGB that evaluated views are drawn over: the run's own, black where that is random."""
    name = setup.config.background
    named = {"black": (0.0, 0.0, 0.0), "random": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
    rgb = named[name] if name in named else tuple(float(part) for part in name.split(","))
    return torch.tensor(rgb, dtype=torch.float32, device=setup.device)


def model_of(setup: Setup, state: TrainState) -> Model:
    """The model as it is after the last step, shared, not copied."""
    return Model(
        phase=setup.phase(state.step, training=True),
        scene=setup.scene,
        backbone=setup.backbone,
        rasterizer=setup.rasterizer,
        parameters=state.parameters,
        adam=state.adam,
        background=eval_background(setup),
        ssim_weight=setup.config.ssim_weight,
        groups=setup.groups,
    )


def _regularize_view(setup: Setup, state: TrainState, drawn: _Drawn, into: TensorGradients) -> None:
    if setup.regularizes:
        add_regularization(setup, state, into, drawn.gaussians, drawn.record.view)


def add_regularization(
    setup: Setup,
    state: TrainState,
    into: TensorGradients,
    gaussians: Gaussians | None = None,
    view: View | None = None,
) -> None:
    """Adds the gradients of all regularisation terms, of one view or (None) of the step."""
    context = RegularizeContext(
        step=state.step,
        schedule=setup.schedule,
        scene=setup.scene,
        states=state.states,
        rng=state.rngs["regularize"],
        photo=partial(photo_of, setup, state),
        parameters=state.parameters,
        backbone=setup.backbone,
        gaussians=gaussians,
        view=view,
    )
    for answer in setup.hook.crossgrad_regularize(context=context):
        state.commit(answer.states)
        _add(into, _gradients_of(answer.loss, state.parameters, keep=gaussians is not None))


def _gradients_of(loss: Tensor, parameters: Mapping[str, Tensor], *, keep: bool) -> TensorGradients:
    wanted = {name: t for name, t in parameters.items() if t.requires_grad}
    if not loss.requires_grad:
        return {}
    found = torch.autograd.grad(loss, list(wanted.values()), retain_graph=keep, allow_unused=True)
    return dict(zip(wanted, found, strict=True))


def _add(into: TensorGradients, more: Mapping[str, Tensor | None]) -> None:
    for name, gradient in more.items():
        if gradient is not None:
            have = into.get(name)
            into[name] = gradient if have is None else have + gradient


def joined(
    gradients: Mapping[str, Tensor | None],
    of_views: TensorGradients,
    of_step: TensorGradients,
    scale: Scale,
) -> TensorGradients:
    """The aggregated gradients with those of the regularisation terms added.

    They follow the operator's scale c(K), so that the terms weigh as much against the photometric
    loss whatever the operator: a term of the step joins c(K) times, each view's c(K) / K times.

    Args:
        gradients: The aggregated gradients.
        of_views: The sum of the gradients of the views' terms.
        of_step: The sum of the gradients of the step's terms.
        scale: What the operator makes of K equal gradients.
    """
    regular = _times(of_views, scale.per_view)
    _add(regular, _times(of_step, scale.per_step))
    result = dict(gradients)
    _add(result, regular)
    return result


def _times(gradients: TensorGradients, factors: Mapping[str, float]) -> TensorGradients:
    """The gradients by their tensors' factors; none where the factor is 0."""
    return {
        name: gradient if factors[name] == 1.0 else gradient * factors[name]
        for name, gradient in gradients.items()
        if gradient is not None and factors[name]
    }


def _backward(loss: Tensor) -> None:
    # A view that draws nothing has a constant image: its gradients are absent, not an error.
    if loss.requires_grad:
        loss.backward()  # type: ignore[no-untyped-call]


def _clear(parameters: Mapping[str, Tensor]) -> None:
    for tensor in parameters.values():
        tensor.grad = None


def _take(parameters: Mapping[str, Tensor]) -> TensorGradients:
    taken = {name: tensor.grad for name, tensor in parameters.items() if tensor.requires_grad}
    _clear(parameters)
    return taken

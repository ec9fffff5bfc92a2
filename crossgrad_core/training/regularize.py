"""Terms of regularisation: their gradients, and how they join those of the photos."""

from collections.abc import Mapping

import torch
from torch import Tensor

from crossgrad_core.contract.contexts import RegularizeContext, RegularizeResult
from crossgrad_core.contract.gaussians import Gaussians
from crossgrad_core.contract.scene import View
from crossgrad_core.gradients.sparse_rows import dense
from crossgrad_core.registry.manager import call_question
from crossgrad_core.training.operator_scale import Scale
from crossgrad_core.training.setup import Setup
from crossgrad_core.training.state import TrainState
from crossgrad_core.training.view_target import context_fields

#: Tensor name -> gradient or None.
TensorGradients = dict[str, Tensor | None]


def add_regularization(
    setup: Setup,
    state: TrainState,
    into: TensorGradients,
    gaussians: Gaussians | None = None,
    view: View | None = None,
) -> None:
    """Adds the gradients of all regularisation terms, of one view or (None) of the step."""
    context = RegularizeContext(
        **context_fields(setup, state, "regularize"),
        parameters=state.current,
        backbone=setup.backbone,
        gaussians=gaussians,
        view=view,
    )
    for answer in call_question(setup.hook.crossgrad_regularize, context, RegularizeResult):
        state.accept(answer.states, setup.hook.crossgrad_regularize)
        _add(into, _gradients_of(answer.loss, state.tensors, keep=gaussians is not None))


def _gradients_of(loss: Tensor, parameters: Mapping[str, Tensor], *, keep: bool) -> TensorGradients:
    wanted = {name: t for name, t in parameters.items() if t.requires_grad}
    if not loss.requires_grad:
        return {}
    found = torch.autograd.grad(loss, list(wanted.values()), retain_graph=keep, allow_unused=True)
    return dict(zip(wanted, found, strict=True))


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

"""Compute gradients of a model for inspection, without training."""

from collections.abc import Sequence

import torch
from torch import Tensor

from crossgrad_core.contract.contexts import Model
from crossgrad_core.contract.scene import View
from crossgrad_core.training.scaled_photos import on_device


def view_gradients(model: Model, view: View, tensors: Sequence[str]) -> dict[str, Tensor]:
    """Return the gradients of the photometric loss of one view. The model does not change.

    Args:
        model: The model.
        view: Any view of the scene.
        tensors: Names of tensors in `model.parameters`.

    Returns: Name -> gradient in the shape of its tensor; tensors that are frozen or that the view
    does not touch are absent.
    """
    wanted = {n: model.parameters[n] for n in tensors if model.parameters[n].requires_grad}
    gaussians = model.backbone.decode(model.parameters, view.camera, model.phase)
    image = model.rasterizer.render(gaussians, view.camera, model.background).image
    photo, mask = on_device((view.photo.image(), view.photo.mask()), image.device)
    loss = model.loss.loss(model.exposed(view, image), photo, mask, None)
    if not loss.requires_grad:
        return {}
    gradients = torch.autograd.grad(loss, list(wanted.values()), allow_unused=True)
    return {n: g.detach() for n, g in zip(wanted, gradients, strict=True) if g is not None}

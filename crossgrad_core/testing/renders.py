"""Renders on request without a run, for contexts of checks and tests."""

from collections.abc import Mapping

import torch
from torch import Tensor

from crossgrad_core.contract.backbone import Backbone
from crossgrad_core.contract.contexts import RenderOnRequest, RequestedRender
from crossgrad_core.contract.loss import Loss
from crossgrad_core.contract.rasterizer import Rasterizer
from crossgrad_core.contract.scene import Scene
from crossgrad_core.contract.schedule import Phase
from crossgrad_core.defaults import LOSS
from crossgrad_core.registry.entries import build
from crossgrad_core.training.scaled_photos import reduced
from crossgrad_core.training.views import camera_at


def renders_of(
    scene: Scene,
    phase: Phase,
    backbone: Backbone,
    rasterizer: Rasterizer,
    parameters: Mapping[str, Tensor],
) -> RenderOnRequest:
    """What a context offers as `render`, over black, without an exposure, with the usual loss."""
    loss = build(Loss, LOSS, {})

    def render(
        view: int,
        scale: float = 1.0,
        outputs: frozenset[str] = frozenset(),
        background: Tensor | None = None,
    ) -> RequestedRender:
        shown = scene.train_views[view]
        camera = camera_at(shown.camera, scale)
        pair = shown.photo.image(), shown.photo.mask()
        photo, mask = pair if scale == 1.0 else reduced(*pair, camera.width, camera.height)
        gaussians = backbone.decode(parameters, camera, phase)
        behind = torch.zeros(3) if background is None else background
        drawn = rasterizer.render(gaussians, camera, behind, outputs)
        return RequestedRender(
            view=shown,
            camera=camera,
            scale=scale,
            gaussians=gaussians,
            render=drawn,
            screen=drawn.screen,
            image=drawn.image,
            photo=photo,
            mask=mask,
            measure=lambda: loss.loss(drawn.image, photo, mask, None),
        )

    return render

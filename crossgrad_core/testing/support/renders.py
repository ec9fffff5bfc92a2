"""Contexts of hooks outside a run: parameters, Gaussians, renders on request, and view records.

In a run, some rows are updated only on demand, when a hook reads these rows. The contexts of a run
therefore use special types instead of a plain dictionary and plain Gaussians.
"""

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from crossgrad_core.contract.blocks import AdamState
from crossgrad_core.contract.contexts import RenderOnRequest, RequestedRender, ViewRecord
from crossgrad_core.contract.gaussians import Gaussians, OnDemand, Screen
from crossgrad_core.contract.scene import Scene, View
from crossgrad_core.contract.schedule import Phase
from crossgrad_core.contract.slots.backbone import Backbone
from crossgrad_core.contract.slots.loss import Loss
from crossgrad_core.contract.slots.rasterizer import Rasterizer
from crossgrad_core.defaults import LOSS
from crossgrad_core.registry.entries import build
from crossgrad_core.training.scaled_photos import reduced
from crossgrad_core.training.state import TrainState
from crossgrad_core.training.views import camera_at


def renders_of(
    scene: Scene,
    phase: Phase,
    backbone: Backbone,
    rasterizer: Rasterizer,
    parameters: Mapping[str, Tensor],
) -> RenderOnRequest:
    """Create the function `render` of a context.

    The renders use a black background, no exposure and the default loss.
    """
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


def parameters_in_a_run(parameters: Mapping[str, Tensor]) -> Mapping[str, Tensor]:
    """Return the tensors in the mapping type that the contexts of a run use."""
    return TrainState(tensors=dict(parameters), moments=AdamState(), rngs={}).current


def gaussians_in_a_run(gaussians: Gaussians, backbone: Backbone) -> Gaussians:
    """Return the Gaussians in the form that a training run uses.

    Tensors that the backbone passes through have on-demand rows.

    In the returned Gaussians, all rows are up to date, so that a request for rows does nothing.
    """
    fields = frozenset(f for f in backbone.passthrough if getattr(gaussians, f) is not None)
    return replace(gaussians, on_demand=OnDemand(fields, lambda _: None)).whole()


def view_record(
    view: View, gaussians: Gaussians, screen: Screen, index: int = 0, scale: float = 1.0
) -> ViewRecord:
    """Create the record of a view with given statistics.

    The photo, the render and the background of the record are black.

    Args:
        view: The view.
        gaussians: The rendered Gaussians.
        screen: Statistics of the Gaussians, including gradients, in pixels of the render.
        index: Position of the view in the training views.
        scale: Side length of the render, divided by the side length of the photo.
    """
    camera = camera_at(view.camera, scale)
    image = torch.zeros(camera.height, camera.width, 3)
    return ViewRecord(
        index=index,
        view=view,
        label=None,
        loss=0.1,
        gaussians=gaussians,
        screen=screen,
        background=torch.zeros(3),
        camera=camera,
        scale=scale,
        image=image,
        photo=image.to(torch.uint8),
        mask=None,
    )

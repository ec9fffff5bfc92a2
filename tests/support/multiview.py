"""Steps of multi-view density control and records of their views, for its tests."""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from crossgrad_backbones.vanilla import Vanilla
from crossgrad_core.contract.blocks import Parameters
from crossgrad_core.contract.contexts import DensifyContext, ViewRecord
from crossgrad_core.contract.scene import Scene
from crossgrad_core.contract.schedule import Phase, Schedule
from crossgrad_core.contract.slots.backbone import Backbone
from crossgrad_core.registry.entries import build
from crossgrad_core.testing.fixtures import sample_scene, step_fields
from crossgrad_core.testing.support.renders import renders_of, view_record

TRAIN = sample_scene().train_views
VIEWS = len(TRAIN)


class Shown:
    """A photo of given pixels and mask."""

    def __init__(self, image: Tensor, mask: Tensor | None = None) -> None:
        self._image, self._mask = image, mask

    def image(self) -> Tensor:
        """[H, W, 3] uint8."""
        return self._image

    def mask(self) -> Tensor | None:
        """[H, W] bool; None where all pixels count."""
        return self._mask


def parameters_of(backbone: Backbone, seed: int = 2) -> Parameters:
    """Parameters of 40 primitives of random sizes and opacities, in front of the sample scene."""
    params = backbone.create(sample_scene(), np.random.default_rng(0))
    rng = np.random.default_rng(seed)
    with torch.no_grad():
        params["scales"] += torch.from_numpy(rng.normal(1.0, 0.5, (40, 3))).float()
        params["opacities"][:] = torch.from_numpy(rng.normal(0.0, 2.0, 40)).float()
    return backbone.prepare(params, sample_scene(), Phase(0, True, Schedule.for_run(30_000)))


def context(
    *,
    backbone: Backbone | None = None,
    params: Parameters | None = None,
    step: int = 600,
    scene: Scene | None = None,
    rasterizer: str = "torch",
    **changes: Any,
) -> DensifyContext:
    """A step of the published schedule; 600 is its second edit."""
    backbone = backbone or Vanilla()
    params = parameters_of(backbone) if params is None else params
    fields = {**step_fields(step), "scene": scene or sample_scene()}
    draws = build("rasterizers", rasterizer, {})
    phase = Phase(step, training=True, schedule=fields["schedule"])
    return DensifyContext(
        **{**fields, "views": (), **changes},
        parameters=params,
        backbone=backbone,
        rasterizer=draws,
        render=renders_of(fields["scene"], phase, backbone, draws, params),
        means_lr=1e-4,
        room=10**6,
    )


def recorded(ctx: DensifyContext, index: int, scale: float = 1.0) -> ViewRecord:
    """The record of a training view, as a step leaves it, with the count."""
    with torch.no_grad():
        drawn = ctx.render(index, scale, frozenset({"count"}))
    record = view_record(drawn.view, drawn.gaussians.detached(), drawn.render.screen, index, scale)
    return replace(
        record, loss=float(drawn.loss), image=drawn.image, photo=drawn.photo, mask=drawn.mask
    )

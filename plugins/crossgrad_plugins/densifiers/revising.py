"""Revising Densification: growth at large image errors (Rota Bulò et al. 2024)."""

from collections.abc import Iterable
from dataclasses import replace
from math import log
from typing import ClassVar, Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor
from typing_extensions import override

from crossgrad_core.numerics.elementwise import logsigmoid, sigmoid
from crossgrad_core.plugin import (
    Camera,
    DensifyContext,
    Edit,
    Gaussians,
    PluginState,
    Rows,
    Schedule,
    apply_to_parameters,
    masked,
    unit_range,
)
from crossgrad_plugins.densifiers.clone_split import CloneSplit, Growth, Plan
from crossgrad_plugins.losses.photometric.reference import ssim_map

ErrorKind = Literal["ssim", "l1"]


def spread_views(number: int, most: int, rng: np.random.Generator) -> list[int]:
    """Return at most `most` indices below `number`: a random one from each of equal ranges."""
    if number <= most:
        return list(range(number))
    edges = np.linspace(0, number, most + 1).astype(np.int64)
    return [int(view) for view in rng.integers(edges[:-1], edges[1:])]


def largest_shares(context: DensifyContext, views: Iterable[int], kind: ErrorKind) -> Tensor:
    """Return [P] the largest share of each primitive in the error of any view, in pixels.

    The views are rendered with the current parameters and the predicted exposure. Each view costs
    two renders and one backward pass.

    Args:
        context: The context of the step, with the parameters and the rasterizer.
        views: Indices in `scene.train_views`.
        kind: The kind of pixel error.
    """
    blocks = context.backbone.blocks()
    name = next(block.tensors[0] for block in blocks if block.per_primitive)
    like = context.parameters[name].detach()
    largest = torch.zeros(like.shape[0], device=like.device)
    background = context.views[-1].background if context.views else None
    for index in views:
        with torch.no_grad():
            drawn = context.render(index, background=background)
            gaussians = drawn.gaussians
            error = pixel_error(drawn.image, (drawn.photo, drawn.mask), kind)
        shares = _shares(context, gaussians.detached(), drawn.camera, error)
        if gaussians.origin is not None:
            shares = torch.zeros_like(largest).index_add_(0, gaussians.origin, shares)
        largest = torch.maximum(largest, shares)
    return largest


def pixel_error(image: Tensor, decoded: tuple[Tensor, Tensor | None], kind: ErrorKind) -> Tensor:
    """Return [H, W] error of each pixel, mean over channels; masked pixels have error 0.

    Args:
        image: [H, W, 3], the render of the view.
        decoded: The photo, [H, W, 3] uint8, and its mask, [H, W] bool or None, on the device of the
            image.
        kind: 1 - SSIM (in [0, 2]) or the absolute difference.
    """
    photo, mask = decoded
    ours, theirs = masked(image, mask), masked(unit_range(photo, image.dtype), mask)
    error = 1 - ssim_map(ours, theirs) if kind == "ssim" else (ours - theirs).abs()
    return masked(error, mask).mean(-1)


def _shares(context: DensifyContext, gaussians: Gaussians, camera: Camera, error: Tensor) -> Tensor:
    """Return [N] sums over pixels of the Gaussian's blending weight times the pixel's error.

    The rasterizer renders each pixel as the sum of blending weight times colour. The result is
    therefore the gradient of the sum of image times error, with respect to one colour channel of
    each Gaussian.
    """
    colors = torch.zeros_like(gaussians.means, requires_grad=True)
    plain = replace(gaussians, colors=colors, sh_dc=None, sh_rest=None, sh_degree=0)
    with torch.enable_grad():
        black = torch.zeros(3, device=error.device)
        image = context.rasterizer.render(plain, camera, black).image
        (gradient,) = torch.autograd.grad((image[..., 0] * error).sum(), colors)
    return gradient[:, 0]


#: Density control ends after the share 27,000 / 30,000 of the steps, as published.
LAST_EDIT_SHARE = 27 / 30
#: Opacities are not lowered below this value.
LEAST_OPACITY = 1e-6
#: Below this logit, float32 cannot distinguish the shared opacity from half of the original
#: opacity.
_FAINT = -15.0


class RevisingDensification(CloneSplit):
    """Clones and splits the Gaussians that have the largest share in the error of a view.

    The share is measured just before an edit. The measurement uses the current parameters, and
    views that are evenly spread over the training views. A clone and its original share the opacity
    of the original, and so do the children of a split. Instead of opacity resets, every edit
    decreases all opacities slightly.
    """

    observes: ClassVar[bool] = False

    error: ErrorKind = Field("ssim", description="error of a pixel: ssim (1 - SSIM) or l1")
    error_threshold: float = Field(
        0.1, gt=0, description="error above which a Gaussian grows, pixels"
    )
    growth_budget: float = Field(
        0.05, gt=0, le=1, description="maximum growth per edit, as a share"
    )
    views: int = Field(
        32, ge=1, description="maximum number of training views that are measured per edit"
    )
    opacity_decrease: float = Field(
        0.001,
        ge=0,
        lt=1,
        description="amount subtracted from all opacities per edit; 0 resets them instead",
    )

    @override
    def window(self, schedule: Schedule) -> Schedule:
        until = round(LAST_EDIT_SHARE * schedule.length)
        resets = schedule.reset_every if self.opacity_decrease == 0 else None
        return replace(schedule.with_edits(until=until), reset_every=resets)

    @override
    def observed(self, context: DensifyContext, state: PluginState) -> PluginState:
        return state

    @override
    def growth(self, context: DensifyContext, state: PluginState, small: Tensor) -> Growth:
        views = spread_views(len(context.scene.train_views), self.views, context.rng)
        share = largest_shares(context, views, self.error)
        grows = share >= self.error_threshold
        growth = Growth(clone=grows & small, split=grows & ~small, strength=share)
        return growth.limited(int(self.growth_budget * share.shape[0]))[0]

    @override
    def grown_values(
        self, context: DensifyContext, state: PluginState, plan: Plan
    ) -> dict[str, Rows]:
        copies = torch.bincount(plan.source, minlength=context.parameters["opacities"].shape[0])
        rows = (copies > 1)[plan.source].nonzero().squeeze(1)
        shared = halved_logits(context.parameters["opacities"].detach()[plan.source[rows]])
        return {**super().grown_values(context, state, plan), "opacities": Rows(shared, rows)}

    @override
    def densify(self, context: DensifyContext, state: PluginState) -> tuple[Edit, PluginState]:
        edit, state = super().densify(context, state)
        schedule, step = context.schedule, context.step
        if self.opacity_decrease == 0 or not (schedule.collects(step) and schedule.densifies(step)):
            return edit, state
        blocks = tuple(b for b in context.backbone.blocks() if "opacities" in b.tensors)
        logits = apply_to_parameters(edit, blocks, context.parameters)["opacities"].detach()
        lowered = Rows(lowered_logits(logits, self.opacity_decrease), keep_moments=True)
        return replace(edit, values={**edit.values, "opacities": lowered}), state


def halved_logits(logits: Tensor) -> Tensor:
    """Return logits [R] of the opacity o' = 1 - sqrt(1 - o).

    Two copies with opacity o' are as opaque as one Gaussian with opacity o.
    """
    transparency = logsigmoid(-logits) / 2  # This is the logarithm of sqrt(1 - o).
    shared = torch.log(-torch.expm1(transparency)) - transparency
    return torch.where(logits < _FAINT, logits - log(2.0), shared)


def lowered_logits(logits: Tensor, decrease: float) -> Tensor:
    """Return logits [P] of the opacities minus `decrease`.

    An opacity below the minimum is not raised.
    """
    lowered = (sigmoid(logits) - decrease).clamp(min=LEAST_OPACITY)
    return torch.minimum(logits, torch.logit(lowered))

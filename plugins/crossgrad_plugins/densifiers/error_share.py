"""Each primitive's share of the training views' error, by one extra backward pass per view."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from crossgrad_core.plugin import Camera, DensifyContext, Gaussians, masked, unit_range
from crossgrad_plugins.losses.photometric.reference import ssim_map

ErrorKind = Literal["ssim", "l1"]


def spread_views(number: int, most: int, rng: np.random.Generator) -> list[int]:
    """At most `most` of `number` views, one drawn uniformly from each of equal runs of them."""
    if number <= most:
        return list(range(number))
    edges = np.linspace(0, number, most + 1).astype(np.int64)
    return [int(view) for view in rng.integers(edges[:-1], edges[1:])]


def largest_shares(context: DensifyContext, views: Iterable[int], kind: ErrorKind) -> Tensor:
    """[P] the largest share that each primitive has in the error of any of the views, pixels.

    The views are drawn with the current parameters, through the exposure; the whole costs two
    renders and one backward pass per view.

    Args:
        context: With the parameters and the rasterizer.
        views: Positions in `scene.train_views`.
        kind: What the error of a pixel is.
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
    """[H, W] error of each pixel, averaged over the channels; 0 where the photo is masked out.

    Args:
        image: [H, W, 3], the render of the view.
        decoded: [H, W, 3] uint8 photo and [H, W] bool mask (None: every pixel counts), on the
            image's device.
        kind: 1 - SSIM (in [0, 2]) or the absolute difference.
    """
    photo, mask = decoded
    ours, theirs = masked(image, mask), masked(unit_range(photo, image.dtype), mask)
    error = 1 - ssim_map(ours, theirs) if kind == "ssim" else (ours - theirs).abs()
    return masked(error, mask).mean(-1)


def _shares(context: DensifyContext, gaussians: Gaussians, camera: Camera, error: Tensor) -> Tensor:
    """[N] sum over pixels of the Gaussian's blending weight times the pixel's error.

    A pixel is the sum of weight times colour, so this is the gradient by the colour (of one
    channel) of the sum over pixels of image times error.
    """
    colors = torch.zeros_like(gaussians.means, requires_grad=True)
    plain = replace(gaussians, colors=colors, sh_dc=None, sh_rest=None, sh_degree=0)
    with torch.enable_grad():
        black = torch.zeros(3, device=error.device)
        image = context.rasterizer.render(plain, camera, black).image
        (gradient,) = torch.autograd.grad((image[..., 0] * error).sum(), colors)
    return gradient[:, 0]

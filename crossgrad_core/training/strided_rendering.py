"""Strided rendering: only one pixel of each n x n block is rendered, at a varying position."""

from dataclasses import replace
from math import isclose

import numpy as np
import torch
from torch import Tensor

from crossgrad_core.contract.gaussians import Gaussians
from crossgrad_core.contract.scene import Camera
from crossgrad_core.contract.slots.rasterizer import Rasterizer
from crossgrad_core.numerics.hashing import hash32
from crossgrad_core.training.scaled_photos import Pair

#: Column and row of the first rendered pixel of an image.
Corner = tuple[int, int]


def stride_of(scale: float, camera: Camera) -> int:
    """Return n for a scale of 1 / n.

    Return 1 if the scale is not of this form, or if an image side has fewer than n pixels.
    """
    whole = round(1.0 / scale)
    fits = isclose(whole * scale, 1.0) and whole <= min(camera.width, camera.height)
    return whole if fits else 1


def corner_of(step: int, slot: int, stride: int) -> Corner:
    """Return a pseudo-random pixel position in an n x n block.

    `slot` is the position of the view in the step.
    """
    cell = hash32(hash32(step) + slot) * stride * stride >> 32
    return cell % stride, cell // stride


def camera_of(camera: Camera, stride: int, corner: Corner) -> Camera:
    """Return the camera whose pixels are every n-th pixel of `camera`, from `corner` on.

    The centre of pixel (i, j) of the result is the centre of pixel `corner` + n (i, j) of `camera`.
    """
    column, row = corner
    return replace(
        camera,
        width=-(-(camera.width - column) // stride),
        height=-(-(camera.height - row) // stride),
        fx=camera.fx / stride,
        fy=camera.fy / stride,
        cx=(camera.cx - column - 0.5) / stride + 0.5,
        cy=(camera.cy - row - 0.5) / stride + 0.5,
    )


def pixels_of(pair: Pair, stride: int, corner: Corner) -> Pair:
    """Return every n-th pixel of a photo [H, W, 3] and its mask [H, W], from `corner` on.

    The results are copies.
    """
    image, mask = pair
    column, row = corner
    taken = (slice(row, None, stride), slice(column, None, stride))
    return _copied(image[taken]), None if mask is None else mask[taken].contiguous()


def _copied(pixels: Tensor) -> Tensor:
    """Return a contiguous copy of the pixels."""
    if not pixels.is_cpu:
        return pixels.contiguous()
    # Torch would copy with a second thread. If all cores are busy, torch would wait for this
    # thread. Copy each channel separately, because NumPy is slow if the inner dimension has only
    # three elements.
    copy = torch.empty(pixels.shape, dtype=pixels.dtype)
    for channel in range(pixels.shape[2]):
        np.copyto(copy.numpy()[:, :, channel], pixels.numpy()[:, :, channel])
    return copy


def as_in_full(gaussians: Gaussians, rasterizer: Rasterizer, stride: int) -> Gaussians:
    """Return the Gaussians with the dilation of the full-size image.

    A pixel of the strided image is n times wider, which changes the unit of the dilation.

    A render of these Gaussians with `camera_of` equals the full render at the rendered pixels.
    Exceptions are Gaussians far outside the image, whose positions are clamped.
    """
    if stride == 1:
        return gaussians
    full = rasterizer.dilation if gaussians.dilation is None else gaussians.dilation
    return replace(gaussians, dilation=full / stride**2)

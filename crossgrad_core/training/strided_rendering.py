"""Views drawn at one pixel of each n x n: in each step another one, and none of them reduced."""

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

#: Column and row of the first pixel that is drawn.
Corner = tuple[int, int]


def stride_of(scale: float, camera: Camera) -> int:
    """The n of a scale 1 / n; 1 where it is none, or a side is shorter: its photo is reduced."""
    whole = round(1.0 / scale)
    fits = isclose(whole * scale, 1.0) and whole <= min(camera.width, camera.height)
    return whole if fits else 1


def corner_of(step: int, slot: int, stride: int) -> Corner:
    """The pixel of each n x n that a step draws of its view at `slot`, as if drawn by lot."""
    place = hash32(hash32(step) + slot) * stride * stride >> 32
    return place % stride, place // stride


def camera_of(camera: Camera, stride: int, corner: Corner) -> Camera:
    """The camera whose pixels are each n-th one of `camera`, from `corner` on.

    The centre of its pixel (i, j) is that of pixel (corner + n (i, j)) there.
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
    """Each n-th pixel of a photo [H, W, 3] and its mask [H, W] from `corner` on, as copies."""
    image, mask = pair
    column, row = corner
    taken = (slice(row, None, stride), slice(column, None, stride))
    return _copied(image[taken]), None if mask is None else mask[taken].contiguous()


def _copied(pixels: Tensor) -> Tensor:
    """The pixels side by side in memory."""
    if not pixels.is_cpu:
        return pixels.contiguous()
    # Torch would share this with a second thread and wait for it where cores are busy. By channels,
    # as NumPy is slow with runs of three.
    copy = torch.empty(pixels.shape, dtype=pixels.dtype)
    for channel in range(pixels.shape[2]):
        np.copyto(copy.numpy()[:, :, channel], pixels.numpy()[:, :, channel])
    return copy


def as_in_full(gaussians: Gaussians, rasterizer: Rasterizer, stride: int) -> Gaussians:
    """The Gaussians with the dilation of the full photo, in pixels n times as wide.

    With it the render of `camera_of` has the values that the full one has at its pixels, but for
    Gaussians so far beyond the border that their positions are clamped there.
    """
    if stride == 1:
        return gaussians
    full = rasterizer.dilation if gaussians.dilation is None else gaussians.dilation
    return replace(gaussians, dilation=full / stride**2)

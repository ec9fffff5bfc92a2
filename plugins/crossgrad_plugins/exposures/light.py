"""Gains and affine maps of images: compiled kernels on the CPU in float32, else plain torch."""

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from typing_extensions import override

from crossgrad_plugins.exposures import srgb


def with_gain(image: Tensor, stops: Tensor) -> Tensor:
    """Return the image with 2^stops times the light.

    The sRGB values are converted to linear light and back.

    Args:
        image: [H, W, 3] sRGB values, also outside [0, 1].
        stops: One number, or [3] one for each channel.
    """
    if not _is_compiled(image, stops):
        return srgb.with_gain(image, stops)
    taken: Tensor = _Gain.apply(image, stops.expand(3))  # type: ignore[no-untyped-call]
    return taken


def mapped(image: Tensor, matrix: Tensor) -> Tensor:
    """Return A x + b for the sRGB values x of every pixel.

    Args:
        image: [H, W, 3] sRGB values.
        matrix: [3, 4] the matrix [A | b].
    """
    if not _is_compiled(image, matrix):
        return image @ matrix[:, :3].T + matrix[:, 3]
    taken: Tensor = _Affine.apply(image, matrix)  # type: ignore[no-untyped-call]
    return taken


def _is_compiled(*tensors: Tensor) -> bool:
    return all(tensor.device.type == "cpu" and tensor.dtype == torch.float32 for tensor in tensors)


class _Gain(torch.autograd.Function):
    @staticmethod
    @override
    def forward(ctx: Any, image: Tensor, stops: Tensor) -> Tensor:
        from crossgrad_plugins.exposures.numba_kernels.gains import PERIOD, expose

        image = image.detach().contiguous()
        gains = torch.exp2(stops.detach().double()).repeat(PERIOD // 3)
        slopes = (gains ** (1.0 / srgb.EXPONENT)).float()
        gains = gains.float()
        taken = torch.empty_like(image)
        expose(_flat(image), gains.numpy(), slopes.numpy(), _flat(taken))
        ctx.save_for_backward(image, taken, gains)
        return taken

    @staticmethod
    @once_differentiable
    @override
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, Tensor]:
        from crossgrad_plugins.exposures.numba_kernels.gains import expose_back

        image, taken, gains = ctx.saved_tensors
        gradient, sums = torch.empty_like(image), np.zeros(3)
        given = _flat(upstream.contiguous())
        expose_back(_flat(image), _flat(taken), given, gains.numpy(), _flat(gradient), sums)
        return gradient, torch.from_numpy(sums).float()


class _Affine(torch.autograd.Function):
    @staticmethod
    @override
    def forward(ctx: Any, image: Tensor, matrix: Tensor) -> Tensor:
        from crossgrad_plugins.exposures.numba_kernels.affine import map_colors

        image, matrix = image.detach().contiguous(), matrix.detach().contiguous()
        taken = torch.empty_like(image)
        map_colors(_flat(image), _flat(matrix), _flat(taken))
        ctx.save_for_backward(image, matrix)
        return taken

    @staticmethod
    @once_differentiable
    @override
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, Tensor]:
        from crossgrad_plugins.exposures.numba_kernels.affine import map_colors_back

        image, matrix = ctx.saved_tensors
        gradient, sums = torch.empty_like(image), np.zeros((3, 4))
        given = _flat(upstream.contiguous())
        map_colors_back(_flat(image), _flat(matrix), given, _flat(gradient), sums)
        return gradient, torch.from_numpy(sums).float()


def _flat(tensor: Tensor) -> np.ndarray[Any, Any]:
    """Return a contiguous tensor as a flat NumPy array that shares its memory, without a graph."""
    return tensor.view(-1).numpy()

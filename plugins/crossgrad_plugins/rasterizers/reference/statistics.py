"""Gradients with respect to projected means in the backward pass: signed, absolute, in bins."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from typing_extensions import override

from crossgrad_core.plugin import Screen

#: Edges of the bins along the longest axis, in standard deviations.
EDGES = (-2.0, -1.0, 0.0, 1.0, 2.0)
BINS, FIELDS = len(EDGES) + 1, 5
#: A projected axis that is shorter than this (pixels) points along the viewing direction, so its
#: direction in the image is undefined.
SHORTEST = 1e-6


@dataclass(frozen=True)
class Recorder:
    """Stores the gradients of the drawn rows in a `Screen`.

    Attributes:
        screen: Object that gets the gradients; each backward pass replaces the gradients of the
            last one.
        index: [V] int64 index of the Gaussian of each drawn row.
        count: Number N of all Gaussians.
        absolute: True if absolute gradients were requested.
        axes: [V, 2] longest axes if directions were requested, else None.
    """

    screen: Screen
    index: Tensor
    count: int
    absolute: bool
    axes: Tensor | None = None

    def record(self, signed: Tensor, sums: Tensor) -> None:
        """Store the gradients [V, 2] of the drawn rows, and the sums from the probe."""
        self.screen.mean_gradient = self._scattered(signed)
        if self.absolute:
            self.screen.abs_gradient = self._scattered(sums[:, :2])
        if self.axes is not None:
            binned = self._scattered(sums[:, 4:])
            self.screen.directions = binned.view(self.count, BINS, FIELDS)

    def probe(self, like: Tensor) -> Tensor:
        """Return the probe [V, 2] of zeros, or [V, 34].

        The 34 columns are two zeros, the axes, and a zero for each sum of a bin.
        """
        zeros = like.new_zeros(len(like), 2)
        if self.axes is None:
            return zeros
        return torch.cat([zeros, self.axes, like.new_zeros(len(like), BINS * FIELDS)], -1)

    def _scattered(self, rows: Tensor) -> Tensor:
        full = rows.new_zeros(self.count, rows.shape[1])
        full[self.index] = rows
        return full


def recorded(table: Tensor, recorder: Recorder) -> tuple[Tensor, Tensor]:
    """Return the unchanged table [V, C] and a probe [V, R]; a backward pass records gradients.

    The first two columns of the table are projected means. The probe is a tensor of extra columns.
    It is passed to the pixels like the means, but does not change the image. The gradient with
    respect to the probe contains sums over pixels (see `offsets`).
    """
    result: tuple[Tensor, Tensor] = _Recorded.apply(table, recorder)  # type: ignore[no-untyped-call]
    return result


def offsets(
    means: Tensor, probe: Tensor, pixels: Tensor, size: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Return the mean minus the pixel centre for each pixel and Gaussian: dx [P, G], dy [P, G].

    The backward pass sums the gradients of the pixels for the means. For the first two columns of
    the probe, it sums the absolute values of these gradients. If the probe has columns after the
    axes, it sums the result of `binned_directions` for them.

    Args:
        means: [G, 2] projected means, pixels.
        probe: [G, R] probe from `recorded`.
        pixels: [P, 2] pixel centres.
        size: Width and height of the image, pixels.
    """
    result: tuple[Tensor, Tensor] = _Offsets.apply(means, probe, pixels, size)  # type: ignore[no-untyped-call]
    return result


class _Recorded(torch.autograd.Function):
    @staticmethod
    @override
    def forward(ctx: Any, table: Tensor, recorder: Recorder) -> tuple[Tensor, Tensor]:
        ctx.recorder = recorder
        return table.view_as(table), recorder.probe(table)

    @staticmethod
    @override
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        table, probe = gradients
        ctx.recorder.record(table[:, :2].clone(), probe.clone())
        return table, None


class _Offsets(torch.autograd.Function):
    @staticmethod
    @override
    def forward(
        ctx: Any, means: Tensor, probe: Tensor, pixels: Tensor, size: tuple[int, int]
    ) -> tuple[Tensor, Tensor]:
        dx, dy = (means.T[:, None, :] - pixels.T[:, :, None]).unbind(0)
        ctx.save_for_backward(means, probe, pixels)
        ctx.size = size
        return dx.contiguous(), dy.contiguous()

    @staticmethod
    @override
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None, None]:
        means, probe, pixels = ctx.saved_tensors
        both = torch.stack(gradients)
        signed, absolute = both.sum(1).T, both.abs().sum(1).T
        if probe.shape[1] == absolute.shape[1]:
            return signed, absolute, None, None
        axes = probe[:, 2:4]
        away = pixels.T[:, :, None] - means.T[:, None, :]
        binned = binned_directions(both, away, axes, ctx.size).flatten(1)
        sums = torch.cat([absolute, torch.zeros_like(axes), binned], -1)
        return signed, sums, None, None


def longest_axes(factors: Tensor, scales: Tensor) -> Tensor:
    """Return [N, 2] a / |a|^2, px^-1, for the projection a of each longest axis.

    The value is 0 if the axis points along the viewing direction.

    Args:
        factors: [N, 2, 3] from `Projection`: the projections of the three axes.
        scales: [N, 3] standard deviations; if scales are equal, the first one counts as the
            largest.
    """
    longest = scales.argmax(-1)[:, None, None].expand(-1, 2, 1)
    axis = factors.gather(-1, longest).squeeze(-1)
    square = axis.square().sum(-1, keepdim=True)
    return torch.where(square > SHORTEST**2, axis / square, 0.0)


def binned_directions(
    gradients: Tensor, offsets: Tensor, axes: Tensor, size: tuple[int, int]
) -> Tensor:
    """Return [G, BINS, FIELDS] the field `Screen.directions`, summed over some pixels.

    Args:
        gradients: [2, P, G] gradient of each pixel with respect to the projected mean of each
            Gaussian.
        offsets: [2, P, G] pixel centre minus mean, pixels.
        axes: [G, 2] axes from `longest_axes`.
        size: Width and height of the image, pixels.
    """
    scaled = gradients * torch.tensor(size).to(gradients, non_blocking=True)[:, None, None]
    # Divide by the larger component first, because squares of small numbers could become zero.
    largest = scaled.abs().amax(0)
    moved = largest > 0
    scaled = scaled / torch.where(moved, largest, 1.0)
    units = scaled / torch.where(moved, scaled.square().sum(0).sqrt(), 1.0)
    along = (offsets * axes.T[:, None, :]).sum(0)
    edges = torch.tensor(EDGES).to(along, non_blocking=True)
    bins = torch.bucketize(along, edges, right=True)
    fields = torch.cat([units, gradients.abs(), moved[None].to(units)])
    bin_sums = [torch.where(bins == number, fields, 0.0).sum(1) for number in range(BINS)]
    return torch.stack(bin_sums).permute(2, 0, 1)

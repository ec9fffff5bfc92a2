"""Gradients of the projected means, signed and absolute, read off the backward pass."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from typing_extensions import override

from crossgrad_core.gaussians import Screen


@dataclass(frozen=True)
class Recorder:
    """Where the gradients of the drawn rows belong.

    Attributes:
        screen: Receives the gradients; each backward pass replaces those of the last.
        index: [V] int64, the Gaussian of each drawn row.
        count: Number N of all Gaussians.
        absolute: Whether absolute gradients were asked for.
    """

    screen: Screen
    index: Tensor
    count: int
    absolute: bool

    def record(self, signed: Tensor, absolute: Tensor) -> None:
        """Takes the gradients [V, 2] of the drawn rows."""
        self.screen.mean_gradient = self._scattered(signed)
        if self.absolute:
            self.screen.abs_gradient = self._scattered(absolute)

    def _scattered(self, rows: Tensor) -> Tensor:
        full = rows.new_zeros(self.count, 2)
        full[self.index] = rows
        return full


def recorded(table: Tensor, recorder: Recorder) -> tuple[Tensor, Tensor]:
    """The same table [V, C], noted on the way back, and a probe [V, 2].

    The first two columns are projected means. The probe is zeros that reach the pixels as means do;
    its gradient is the sum of the absolute values of the pixels' gradients (see `offsets`).
    """
    result: tuple[Tensor, Tensor] = _Recorded.apply(table, recorder)  # type: ignore[no-untyped-call]
    return result


def offsets(means: Tensor, probe: Tensor, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Mean minus pixel centre for every pixel and Gaussian: dx [P, G] and dy [P, G].

    Backward sums the pixels' gradients for the means, and their absolute values for the probe.

    Args:
        means: [G, 2] pixels.
        probe: [G, 2] from `recorded`.
        pixels: [P, 2] pixel centres.
    """
    result: tuple[Tensor, Tensor] = _Offsets.apply(means, probe, pixels)  # type: ignore[no-untyped-call]
    return result


class _Recorded(torch.autograd.Function):
    @staticmethod
    @override
    def forward(ctx: Any, table: Tensor, recorder: Recorder) -> tuple[Tensor, Tensor]:
        ctx.recorder = recorder
        return table.view_as(table), table.new_zeros(len(table), 2)

    @staticmethod
    @override
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        table, probe = gradients
        ctx.recorder.record(table[:, :2].clone(), probe.clone())
        return table, None


class _Offsets(torch.autograd.Function):
    @staticmethod
    @override
    def forward(ctx: Any, means: Tensor, probe: Tensor, pixels: Tensor) -> tuple[Tensor, Tensor]:
        dx, dy = (means.T[:, None, :] - pixels.T[:, :, None]).unbind(0)
        return dx.contiguous(), dy.contiguous()

    @staticmethod
    @override
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None]:
        signed = torch.stack([g.sum(0) for g in gradients], -1)
        absolute = torch.stack([g.abs().sum(0) for g in gradients], -1)
        return signed, absolute, None

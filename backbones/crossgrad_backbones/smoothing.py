"""The 3-D smoothing filter of Mip-Splatting: how wide it is, and Gaussians widened by it."""

from collections.abc import Sequence
from math import sqrt
from typing import Any

import torch
from torch import Tensor
from typing_extensions import override

from crossgrad_backbones.visibility import finest_pixels
from crossgrad_core.numerics.elementwise import sigmoid
from crossgrad_core.plugin import Camera

#: Variance of the filter in squared pixels of the camera that sees a Gaussian finest.
VARIANCE = 0.2


@torch.no_grad()
def filter_widths(means: Tensor, cameras: Sequence[Camera], near: float, *, parity: bool) -> Tensor:
    """[N] standard deviation of each Gaussian's filter, local units.

    sqrt(VARIANCE) z / f, the least over the cameras that see the mean; Gaussians that none sees
    get the largest width of the others (0 where there are no others).

    Args:
        means: [N, 3] local units.
        cameras: The training cameras.
        near: Near plane, local units.
        parity: Divide the least depth by the longest focal length of all cameras, whichever sees
            the Gaussian, as the published code does.
    """
    focal = max(camera.fx for camera in cameras) if parity else None
    finest = finest_pixels(means, cameras, near, focal)
    seen = finest.isfinite()
    largest = finest[seen].max() if bool(seen.any()) else finest.new_zeros(())
    return sqrt(VARIANCE) * torch.where(seen, finest, largest)


def kept_opacity(log_scales: Tensor, widths: Tensor) -> Tensor:
    """[N] what the filter leaves of an opacity, for log scales [N, 3] and widths [N], detached."""
    scales, filters = _finite_scales(log_scales.detach()), _per_axis(widths)
    return (scales / torch.hypot(scales, filters)).prod(1)


def smoothed(log_scales: Tensor, logits: Tensor, widths: Tensor) -> tuple[Tensor, Tensor]:
    """Scales sqrt(s^2 + w^2) [N, 3] and opacities o sqrt(prod s^2 / prod (s^2 + w^2)) [N].

    Computed as ratios of lengths, which neither overflow nor underflow before their product does.
    The derivatives are written out, which takes half the time of autograd's own.

    Args:
        log_scales: [N, 3] logarithms of s.
        logits: [N] logits of o.
        widths: [N] standard deviations w; they get no gradient.
    """
    found: tuple[Tensor, Tensor] = _Smoothed.apply(log_scales, logits, widths)  # type: ignore[no-untyped-call]
    return found


class _Smoothed(torch.autograd.Function):
    """With S = hypot(s, w), k = s / S: dS/d(log s) = S k^2, d(log prod k)/d(log s) = (w / S)^2."""

    @staticmethod
    @override
    def forward(ctx: Any, log_scales: Tensor, logits: Tensor, widths: Tensor) -> Any:
        scales, filters = _finite_scales(log_scales), _per_axis(widths)
        smooth = torch.hypot(scales, filters)
        kept = scales.div_(smooth)
        opacities = sigmoid(logits)
        drawn = opacities * kept.prod(1)
        # In place: at this size, new memory costs more than the arithmetic.
        shares = kept.square_(), filters.div_(smooth).square_()
        ctx.save_for_backward(smooth, *shares, opacities, drawn)
        return smooth, drawn

    @staticmethod
    @override
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        smooth, kept_share, lost_share, opacities, drawn = ctx.saved_tensors
        by_log_opacity = gradients[1] * drawn
        by_scales = (gradients[0] * smooth).mul_(kept_share)
        by_scales.addcmul_(by_log_opacity[:, None], lost_share)
        return by_scales, by_log_opacity * (1 - opacities), None


def _finite_scales(log_scales: Tensor) -> Tensor:
    """exp, kept inside the range of the number type so that no quotient of two is undefined."""
    limits = torch.finfo(log_scales.dtype)
    return log_scales.exp().clamp_(limits.tiny, limits.max)


def _per_axis(values: Tensor) -> Tensor:
    """[N, 3] contiguous: element-wise work on an expanded view is slower."""
    return values[:, None].expand(-1, 3).contiguous()

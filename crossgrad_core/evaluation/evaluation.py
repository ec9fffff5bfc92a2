"""Evaluation of held-out views: metrics of each view, means overall and per regime, and PSNR.

Before the comparison, the render and the photo are clamped to [0, 1] and rounded to 8 bits per
channel, as in image files. Masked pixels do not count. Metrics are means over images.

Source: 3DGS evaluation scripts.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_core.contract.scene import View, to_uint8
from crossgrad_core.contract.slots.metric import Compared, Metric
from crossgrad_core.evaluation.result import EvaluationResult, ViewMetrics, summarised

#: PSNR of identical images, in dB. The value is finite, because JSON has no infinity and the mean
#: over views must stay finite. Two different images reach this limit only if less than one value in
#: 150,000 differs by one 8-bit step.
PSNR_LIMIT = 100.0
#: Number of pixels that are compared at once, so that their differences fit into the CPU cache.
_AT_ONCE = 2**15


@dataclass(frozen=True, eq=False)
class Evaluated:
    """A view with its compared images and its metrics."""

    compared: Compared
    metrics: ViewMetrics


def evaluate(
    views: Sequence[View],
    render_one: Callable[[View], Tensor],
    metrics: Sequence[Metric],
    on_view: Callable[[Evaluated], None] | None = None,
    points: NDArray[np.float64] | None = None,
) -> EvaluationResult:
    """Render and measure the views, one at a time.

    Args:
        views: The held-out views. If there are none, all metrics are null, and the result gives the
            reason.
        render_one: Returns the [H, W, 3] float image of a view, on any device; the values need not
            be clamped.
        metrics: The metrics to measure.
        on_view: Called with each view and its render, for panels.
        points: [P, 3] SfM points of the scene, local frame, for metrics that need them.
    """
    measured = []
    with torch.no_grad():
        for view in views:
            compared = compare(view, render_one(view), points)
            metrics_of_view = _measured(compared, metrics)
            measured.append(metrics_of_view)
            if on_view is not None:
                on_view(Evaluated(compared, metrics_of_view))
    return summarised(measured, [metric.described() for metric in metrics])


def compare(view: View, render: Tensor, points: NDArray[np.float64] | None = None) -> Compared:
    """Return the data of a view that metrics compare; the render [H, W, 3] is rounded to 8 bits."""
    photo, mask = view.photo.image(), view.photo.mask()
    seen = np.zeros((0, 3)) if points is None else points[view.seen]
    return Compared(view, to_uint8(render), photo, mask, render.detach().cpu(), seen)


def _measured(compared: Compared, metrics: Sequence[Metric]) -> ViewMetrics:
    answers = {metric.figure.name: metric.measure(compared) for metric in metrics}
    # Convert to float, because a tensor would be written to files in its text form.
    values = {name: None if value is None else float(value) for name, value in answers.items()}
    view, mask = compared.view, compared.mask
    masked = mask is not None and not bool(mask.any())
    return ViewMetrics(view.name, view.regime, values, masked)


def psnr(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float | None:
    """Return the peak signal-to-noise ratio over all unmasked pixels and channels, in dB.

    Args:
        image: [H, W, 3] in [0, 1], or uint8.
        target: [H, W, 3] the photo, in the same form as `image`.
        mask: [H, W] bool, True where the pixel counts; None counts all pixels.

    Returns: At most `PSNR_LIMIT`; None if no pixel counts.

    Source: 3DGS evaluation script: 20 log10(1 / sqrt(MSE)).
    """
    rendered, photo = (
        pixels.reshape(-1, 3) if mask is None else pixels[mask]
        for pixels in (to_uint8(image), to_uint8(target))
    )
    if rendered.numel() == 0:
        return None
    # This sum is exact, because squares and sums are whole numbers that float32 and float64 can
    # represent.
    total = 0.0
    for ours, theirs in zip(
        *(torch.split(pixels, _AT_ONCE) for pixels in (rendered, photo)), strict=True
    ):
        difference = ours.to(torch.float32) - theirs.to(torch.float32)
        total += float((difference * difference).sum(dtype=torch.float64))
    mean_square = total / rendered.numel() / 255**2
    return min(-10 * float(np.log10(mean_square)), PSNR_LIMIT) if mean_square > 0 else PSNR_LIMIT

"""Evaluation of held-out views: every metric of each, means overall and per regime.

Source: 3DGS evaluation scripts; each render is rounded to 8 bits per channel before it is compared,
metrics are means over images. Masked pixels do not count.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from crossgrad_core.contract.metric import Compared, Metric
from crossgrad_core.contract.scene import View, to_uint8
from crossgrad_core.evaluation.result import EvaluationResult, ViewMetrics, summarised


@dataclass(frozen=True, eq=False)
class Evaluated:
    """A view with what was compared and its figures."""

    compared: Compared
    metrics: ViewMetrics


def evaluate(
    views: Sequence[View],
    render_one: Callable[[View], Tensor],
    metrics: Sequence[Metric],
    on_view: Callable[[Evaluated], None] | None = None,
    points: NDArray[np.float64] | None = None,
) -> EvaluationResult:
    """Renders and measures the views, one at a time.

    Args:
        views: The held-out views; none gives figures that are null, with the reason.
        render_one: [H, W, 3] float image of a view, on any device, need not be clamped.
        metrics: What is measured.
        on_view: Told each view with its render, for panels.
        points: [P, 3] SfM points of the scene, local frame, for figures that need them.
    """
    measured = []
    with torch.no_grad():
        for view in views:
            compared = compare(view, render_one(view), points)
            found = _measured(compared, metrics)
            measured.append(found)
            if on_view is not None:
                on_view(Evaluated(compared, found))
    return summarised(measured, [metric.described() for metric in metrics])


def compare(view: View, render: Tensor, points: NDArray[np.float64] | None = None) -> Compared:
    """The view's photo and its render [H, W, 3], rounded to 8 bits, and the points it observed."""
    photo, mask = view.photo.image(), view.photo.mask()
    seen = np.zeros((0, 3)) if points is None else points[view.seen]
    return Compared(view, to_uint8(render), photo, mask, render.detach().cpu(), seen)


def _measured(compared: Compared, metrics: Sequence[Metric]) -> ViewMetrics:
    found = {metric.figure.name: metric.measure(compared) for metric in metrics}
    # Of a tensor, say, files would hold the text.
    values = {name: None if value is None else float(value) for name, value in found.items()}
    view, mask = compared.view, compared.mask
    masked = mask is not None and not bool(mask.any())
    return ViewMetrics(view.name, view.regime, values, masked)

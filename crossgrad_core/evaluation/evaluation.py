"""Evaluation of held-out views: metrics per view, means overall and per regime.

Source: 3DGS evaluation scripts; each render is rounded to 8 bits per channel before it is compared,
metrics are means over images. Masked pixels do not count.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import fsum

import torch
from torch import Tensor

from crossgrad_core.contract.scene import View

NO_VIEWS = "no held-out views: the split keeps every view for training"
ALL_MASKED = "every pixel is masked"

#: [H, W, 3] render, [H, W, 3] photo, both in [0, 1] -> LPIPS.
Lpips = Callable[[Tensor, Tensor], float]


@dataclass(frozen=True)
class ViewMetrics:
    """The metrics of one view; None where they could not be computed.

    Attributes:
        name: Name of the view.
        regime: Its regime.
        psnr: dB, over all channels.
        ssim: 3DGS form: zero-padded 11 x 11 window, sigma 1.5.
        ssim_skimage: scikit-image with Gaussian weights, sigma 1.5, no sample covariance.
        lpips: None unless given a function that computes it.
    """

    name: str
    regime: str
    psnr: float | None
    ssim: float | None
    ssim_skimage: float | None
    lpips: float | None


@dataclass(frozen=True)
class Means:
    """Means over `views` views; None where no view has the metric."""

    views: int
    psnr: float | None
    ssim: float | None
    ssim_skimage: float | None
    lpips: float | None


@dataclass(frozen=True)
class EvaluationResult:
    """What an evaluation found.

    Attributes:
        views: Metrics of each view, in the order of the scene.
        overall: Means over all views.
        regimes: Regime -> means over its views, sorted by name.
        reasons: Metric -> why it is null.
    """

    views: tuple[ViewMetrics, ...]
    overall: Means
    regimes: Mapping[str, Means]
    reasons: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Evaluated:
    """A view with what was rendered for it.

    Attributes:
        view: The view.
        render: [H, W, 3] uint8 on the CPU.
        photo: [H, W, 3] uint8.
        mask: [H, W] bool, True where the pixel counts; None where every pixel counts.
        metrics: The view's metrics.
    """

    view: View
    render: Tensor
    photo: Tensor
    mask: Tensor | None
    metrics: ViewMetrics


def evaluate(
    views: Sequence[View],
    render_one: Callable[[View], Tensor],
    lpips: Lpips | None = None,
    on_view: Callable[[Evaluated], None] | None = None,
) -> EvaluationResult:
    """Renders and measures the views, one at a time.

    Args:
        views: The held-out views; none gives metrics that are null, with the reason.
        render_one: [H, W, 3] float image of a view, on any device, need not be clamped.
        lpips: Computes LPIPS; None leaves it out.
        on_view: Told each view with its render, for panels.
    """
    measured = []
    with torch.no_grad():
        for view in views:
            evaluated = _evaluated(view, render_one(view), lpips)
            measured.append(evaluated.metrics)
            if on_view is not None:
                on_view(evaluated)
    return summarised(measured)


def summarised(views: Sequence[ViewMetrics]) -> EvaluationResult:
    """Means overall and per regime of views that were measured."""
    names = sorted({view.regime for view in views})
    regimes = {name: _means([view for view in views if view.regime == name]) for name in names}
    overall = _means(views)
    return EvaluationResult(tuple(views), overall, regimes, _reasons(views, overall))


def _evaluated(view: View, render: Tensor, lpips: Lpips | None) -> Evaluated:
    from crossgrad_core.evaluation.metrics import psnr, quantise, ssim, ssim_skimage

    photo, mask = view.photo.image(), view.photo.mask()
    image = (quantise(render.detach().cpu()) * 255.0).round().to(torch.uint8)
    counts = mask is None or bool(mask.any())
    metrics = ViewMetrics(
        name=view.name,
        regime=view.regime,
        psnr=psnr(image, photo, mask),
        ssim=ssim(image, photo, mask),
        ssim_skimage=ssim_skimage(image, photo, mask),
        lpips=lpips(image / 255.0, photo / 255.0) if lpips is not None and counts else None,
    )
    return Evaluated(view, image, photo, mask, metrics)


def _means(views: Sequence[ViewMetrics]) -> Means:
    return Means(
        views=len(views),
        psnr=_mean([view.psnr for view in views]),
        ssim=_mean([view.ssim for view in views]),
        ssim_skimage=_mean([view.ssim_skimage for view in views]),
        lpips=_mean([view.lpips for view in views]),
    )


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return fsum(known) / len(known) if known else None


def _reasons(views: Sequence[ViewMetrics], overall: Means) -> dict[str, str]:
    from crossgrad_core.evaluation.metrics import SSIM_SKIMAGE_TOO_SMALL, lpips_unavailable_reason

    if not views:
        return dict.fromkeys(("psnr", "ssim", "ssim_skimage", "lpips"), NO_VIEWS)
    reasons = {}
    if overall.psnr is None:
        reasons = dict.fromkeys(("psnr", "ssim", "ssim_skimage"), ALL_MASKED)
    elif overall.ssim_skimage is None:
        reasons["ssim_skimage"] = SSIM_SKIMAGE_TOO_SMALL
    if overall.lpips is None:
        reasons["lpips"] = lpips_unavailable_reason()
    return reasons

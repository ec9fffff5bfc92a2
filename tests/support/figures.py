"""Figures of several kinds that a run may measure: by regime or not, null or not."""

from crossgrad_core.evaluation.result import ViewMetrics
from crossgrad_core.registry.entries import build
from crossgrad_core.run.results.metrics_csv import columns_for

METRICS = tuple(build("metrics", name, {}) for name in ("psnr", "ssim", "ssim-skimage", "lpips"))
FIGURES = tuple(metric.figure for metric in METRICS)


def of(name, regime, *values):
    """A view with these figures in order."""
    names = [figure.name for figure in FIGURES]
    return ViewMetrics(name, regime, dict(zip(names, values, strict=True)))


def columns(regimes):
    """The columns of metrics.csv with these regimes."""
    return columns_for(regimes, FIGURES)

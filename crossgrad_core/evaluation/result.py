"""Results of an evaluation: metrics of each view, and means overall and per regime.

This module does not import torch.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import fsum

from crossgrad_core.contract.figure import Figure

NO_VIEWS = "no held-out views: all views are used for training"
ALL_MASKED = "every pixel is masked"


@dataclass(frozen=True)
class ViewMetrics:
    """The metrics of one view.

    Attributes:
        name: Name of the view.
        regime: The regime of the view.
        values: Name of a metric -> value; None if the metric is undefined for the view.
        masked: True if all pixels of the view are masked.
    """

    name: str
    regime: str
    values: Mapping[str, float | None]
    masked: bool = False

    def __getitem__(self, figure: str) -> float | None:
        return self.values[figure]


@dataclass(frozen=True)
class Means:
    """Mean metrics of `views` views (fully masked views excluded); None if no view has a value."""

    views: int
    values: Mapping[str, float | None]

    def __getitem__(self, figure: str) -> float | None:
        return self.values[figure]

    def as_data(self) -> dict[str, float | int | None]:
        """Return the number of views and the metrics by name."""
        return {"views": self.views, **self.values}


@dataclass(frozen=True)
class EvaluationResult:
    """The results of an evaluation.

    Attributes:
        figures: The measured metrics, in their order in all tables.
        views: Metrics of each view, in the order of the scene.
        overall: Means over all views.
        regimes: Regime -> means over its views, sorted by name.
        reasons: Name of a metric -> reason why the metric is null.
    """

    figures: tuple[Figure, ...]
    views: tuple[ViewMetrics, ...]
    overall: Means
    regimes: Mapping[str, Means]
    reasons: Mapping[str, str] = field(default_factory=dict)


def summarised(views: Sequence[ViewMetrics], figures: Sequence[Figure]) -> EvaluationResult:
    """Return the results with means overall and per regime."""
    names = sorted({view.regime for view in views})
    regimes = {
        name: _means([view for view in views if view.regime == name], figures) for name in names
    }
    overall = _means(views, figures)
    reasons = {
        figure.name: _reason(figure, views) for figure in figures if overall[figure.name] is None
    }
    return EvaluationResult(tuple(figures), tuple(views), overall, regimes, reasons)


def _means(views: Sequence[ViewMetrics], figures: Sequence[Figure]) -> Means:
    means = {figure.name: _mean([view[figure.name] for view in views]) for figure in figures}
    return Means(sum(not view.masked for view in views), means)


def _mean(values: Sequence[float | None]) -> float | None:
    numbers = [value for value in values if value is not None]
    return fsum(numbers) / len(numbers) if numbers else None


def _reason(figure: Figure, views: Sequence[ViewMetrics]) -> str:
    if not views:
        return NO_VIEWS
    return ALL_MASKED if all(view.masked for view in views) else figure.undefined

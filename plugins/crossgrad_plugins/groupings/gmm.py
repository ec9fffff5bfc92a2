"""Groups of cameras by a two-component Gaussian mixture of log-distances."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from typing_extensions import override

from crossgrad_core.plugin import (
    GradientProbe,
    Grouping,
    GroupingRule,
    Quantity,
    Scene,
    View,
    radial_distances,
)
from crossgrad_plugins.groupings.distance import Radial
from crossgrad_plugins.groupings.split import FAR, NEAR, log_distances, require_training_views

_VARIANCE_FLOOR = 1e-6
#: A mixture needs at least two cameras.
_FEWEST = 2
_ITERATIONS = 500
_TOLERANCE = 1e-10


class GaussianMixture(Grouping):
    """Fits a mixture of two components to log-distances.

    The component with the smaller mean is near. If the fit is degenerate, the median is used as in
    grouping `radial`, and the log contains a note. A fit is degenerate if a component weighs less
    than one camera, if a component gets no camera, or if a number is not finite. A camera at the
    mean of all cameras has distance 0 and therefore no log-distance. This camera is near and is not
    used in the fit.

    Source: expectation maximisation (Dempster et al. 1977) in one dimension.
    """

    restarts: int = Field(
        10, ge=1, description="number of random starts; the most likely fit is used"
    )

    @override
    def fit(
        self, scene: Scene, rng: np.random.Generator, probe: GradientProbe | None = None
    ) -> GroupingRule:
        require_training_views(scene, "gmm")
        distances = radial_distances(scene, scene.train_views)
        away = distances[distances > 0.0]
        mixture = _fit(np.log(away), self.restarts, rng)
        if mixture is None or len(set(mixture.labels(away))) == 1:
            median = Radial().fit(scene, rng)
            fallback = "grouping gmm: the mixture is degenerate; the median split is used instead"
            return GroupingRule(median.labels, (fallback, *median.notes))
        near, far = np.exp(mixture.means)
        note = f"grouping gmm: components at {near:.4g} and {far:.4g} local units"
        return GroupingRule(lambda views: mixture.labels(radial_distances(scene, views)), (note,))

    @override
    def quantity(self, scene: Scene, views: Sequence[View]) -> Quantity:
        return log_distances(scene, views)


@dataclass(frozen=True, eq=False)
class _Mixture:
    """Weights, means (ascending) and variances, [2] each, and the fit's log-likelihood."""

    weights: NDArray[np.float64]
    means: NDArray[np.float64]
    variances: NDArray[np.float64]
    likelihood: float

    def labels(self, distances: NDArray[np.float64]) -> tuple[str, ...]:
        """Return the label of the more probable component for each distance [V]."""
        nowhere = distances == 0.0
        near, far = _log_joint(np.log(np.where(nowhere, 1.0, distances)), self).T
        return tuple(NEAR if is_near else FAR for is_near in (near >= far) | nowhere)


def _fit(logs: NDArray[np.float64], restarts: int, rng: np.random.Generator) -> _Mixture | None:
    """Return the most likely of several fits, or None if all fits are degenerate."""
    if len(logs) < _FEWEST or (spread := float(logs.var())) == 0.0:
        return None
    fits = [_expectation_maximisation(logs, spread, rng) for _ in range(restarts)]
    usable = [fit for fit in fits if _usable(fit, len(logs))]
    return max(usable, key=lambda fit: fit.likelihood, default=None)


def _usable(mixture: _Mixture, cameras: int) -> bool:
    figures = np.concatenate([mixture.weights, mixture.means, mixture.variances])
    return bool(np.isfinite(figures).all() and mixture.weights.min() >= 1.0 / cameras)


def _expectation_maximisation(
    logs: NDArray[np.float64], spread: float, rng: np.random.Generator
) -> _Mixture:
    """Return one fit; the means start at the log-distances of two random cameras."""
    starts = np.sort(rng.choice(logs, size=2, replace=False))
    mixture = _Mixture(np.full(2, 0.5), starts, np.full(2, spread), -np.inf)
    for _ in range(_ITERATIONS):
        joint = _log_joint(logs, mixture)
        evidence = np.logaddexp(joint[:, 0], joint[:, 1])
        likelihood = float(evidence.sum())
        if likelihood - mixture.likelihood <= _TOLERANCE * len(logs):
            break
        shares = np.exp(joint - evidence[:, None])
        mixture = _maximised(logs, shares, _VARIANCE_FLOOR * spread, likelihood)
    order = np.argsort(mixture.means)
    return _Mixture(
        mixture.weights[order],
        mixture.means[order],
        mixture.variances[order],
        mixture.likelihood,
    )


def _maximised(
    logs: NDArray[np.float64],
    shares: NDArray[np.float64],
    variance_floor: float,
    likelihood: float,
) -> _Mixture:
    """Return the mixture of the cameras' weighted moments; `shares` [N, 2] are the weights."""
    # A component without any camera needs finite values. `_usable` rejects such a component because
    # of its weight.
    totals = np.maximum(shares.sum(axis=0), np.finfo(np.float64).tiny)
    means = (shares * logs[:, None]).sum(axis=0) / totals
    squares = (shares * (logs[:, None] - means) ** 2).sum(axis=0) / totals
    variances = np.maximum(squares, variance_floor)
    return _Mixture(totals / len(logs), means, variances, likelihood)


def _log_joint(logs: NDArray[np.float64], mixture: _Mixture) -> NDArray[np.float64]:
    """Return [V, 2] logarithm of each component's weight times density."""
    squared = (logs[:, None] - mixture.means) ** 2 / mixture.variances
    constant = np.log(mixture.weights) - 0.5 * np.log(2.0 * np.pi * mixture.variances)
    return np.asarray(constant - 0.5 * squared)

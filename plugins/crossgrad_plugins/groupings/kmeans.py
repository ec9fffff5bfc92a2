"""Groups of cameras by two clusters of their positions."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from typing_extensions import override

from crossgrad_core.plugin import (
    GradientProbe,
    Grouping,
    GroupingRule,
    Scene,
    View,
    centers_of,
    radial_distances,
)
from crossgrad_plugins.groupings.split import (
    FAR,
    NEAR,
    require_groups,
    require_training_views,
    smaller_mean_first,
)

_ITERATIONS = 200


class KMeans(Grouping):
    """Two k-means clusters of the camera centres.

    The cluster with the smaller mean radial distance is near.

    Source: Lloyd's algorithm with k-means++ seeding (Arthur and Vassilvitskii 2007).
    """

    restarts: int = Field(
        10, ge=1, description="number of random starts; the tightest clustering is used"
    )

    @override
    def fit(
        self, scene: Scene, rng: np.random.Generator, probe: GradientProbe | None = None
    ) -> GroupingRule:
        require_training_views(scene, "kmeans")
        points = centers_of(scene.train_views)
        trials = [_lloyd(points, _seeds(points, rng)) for _ in range(self.restarts)]
        centroids, _ = min(trials, key=lambda trial: trial[1])
        clusters = _nearest(points, centroids)
        near = smaller_mean_first(clusters, radial_distances(scene, scene.train_views))
        train = [NEAR if cluster == near else FAR for cluster in clusters]
        require_groups("kmeans", train, (NEAR, FAR), "position")
        note = (
            f"grouping kmeans: {train.count(NEAR)} near and {train.count(FAR)} far training views"
        )

        def labels(views: Sequence[View]) -> tuple[str, ...]:
            clusters = _nearest(centers_of(views), centroids)
            return tuple(NEAR if cluster == near else FAR for cluster in clusters)

        return GroupingRule(labels, (note,))


def _nearest(points: NDArray[np.float64], centroids: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return [V] index of the nearest of the centroids [2, 3]."""
    squared = ((points[:, None, :] - centroids[None, :, :]) ** 2).sum(axis=2)
    return np.asarray(squared.argmin(axis=1))


def _seeds(points: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Return two points [2, 3] as the first centroids.

    The probability of the second point is proportional to its squared distance from the first.
    """
    first = points[int(rng.integers(len(points)))]
    squared = ((points - first) ** 2).sum(axis=1)
    total = float(squared.sum())
    weights = squared / total if total > 0.0 else None
    return np.stack([first, points[int(rng.choice(len(points), p=weights))]])


def _lloyd(
    points: NDArray[np.float64], centroids: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float]:
    """Return the centroids after convergence, and the sum of squared distances to them."""
    for _ in range(_ITERATIONS):
        clusters = _nearest(points, centroids)
        if len(np.unique(clusters)) < len(centroids):
            break
        moved = np.stack([points[clusters == c].mean(axis=0) for c in range(len(centroids))])
        if np.array_equal(moved, centroids):
            break
        centroids = moved
    clusters = _nearest(points, centroids)
    return centroids, float(((points - centroids[clusters]) ** 2).sum())

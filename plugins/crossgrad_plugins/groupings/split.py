"""Labels from a threshold, the choice of the threshold, and a check that every group has views."""

from collections.abc import Callable, Sequence
from typing import Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.plugin import GroupingRule, Quantity, Scene, UserError, View, radial_distances

#: How the threshold between near and far is found: the median distance, or Otsu's threshold of the
#: log-distances.
Cut: TypeAlias = Literal["median", "otsu"]
CUT: Final = "threshold between near and far: the median, or Otsu's threshold of the logarithms"
NEAR, MIDDLE, FAR = "near", "middle", "far"


def halves(values: NDArray[np.float64], threshold: float) -> tuple[str, ...]:
    """Return `near` for each value [V] up to the threshold, else `far`."""
    return tuple(NEAR if value <= threshold else FAR for value in values)


def rule_of_distances(
    scene: Scene, grouping: str, threshold_of: Callable[[NDArray[np.float64]], float | np.floating]
) -> GroupingRule:
    """Return the rule that labels cameras up to a threshold distance `near`.

    Distances are measured from the mean training camera.

    Args:
        scene: The scene.
        grouping: Name of the grouping.
        threshold_of: Function that returns the threshold for the distances [V] of the training
            views.

    Raises:
        UserError: There are no training views, or all views are on one side of the threshold.
    """
    require_training_views(scene, grouping)
    train = radial_distances(scene, scene.train_views)
    threshold = float(threshold_of(train))
    require_groups(grouping, halves(train, threshold), (NEAR, FAR), "distance from their mean")
    note = f"grouping {grouping}: near up to {threshold:.4g} local units from the mean camera"
    return GroupingRule(lambda views: halves(radial_distances(scene, views), threshold), (note,))


def cut_of(distances: NDArray[np.float64], cut: Cut) -> float:
    """Return the threshold of distances [V >= 1].

    Distances of 0 do not affect Otsu's threshold.
    """
    if cut == "median" or not (distances > 0.0).any():
        return float(np.median(distances))
    return float(np.exp(otsu_threshold(np.log(distances[distances > 0.0]))))


def log_distances(scene: Scene, views: Sequence[View]) -> Quantity:
    """Return the logarithms of the distances from the mean training camera; -inf for distance 0."""
    distances = radial_distances(scene, views)
    logs = np.full(len(distances), -np.inf)
    np.log(distances, out=logs, where=distances > 0.0)
    return Quantity("the log distance from the mean camera", logs)


def require_training_views(scene: Scene, grouping: str) -> None:
    """Raise an error if a scene has no training views.

    Raises:
        UserError: There are no views to which the rule could be fitted.
    """
    if not scene.train:
        raise UserError(
            f"grouping {grouping} cannot be computed: there are no training views",
            where=scene.name,
            todo="check the split: --split none trains on all images",
        )


def require_groups(
    grouping: str, train_labels: Sequence[str], labels: Sequence[str], quantity: str
) -> None:
    """Raise an error if a rule leaves a group without training views.

    Args:
        grouping: Name of the grouping.
        train_labels: Labels of the training views.
        labels: Every label that the rule can return.
        quantity: The quantity that the rule uses, for the message.

    Raises:
        UserError: A group is empty.
    """
    counts = {label: list(train_labels).count(label) for label in labels}
    if all(counts.values()):
        return
    raise UserError(
        f"grouping {grouping} left a group without training views",
        where="grouping",
        expected=f"training views that differ in {quantity}",
        found=", ".join(f"{label}: {count}" for label, count in counts.items()),
        todo="choose another grouping (lists uses folders or your own lists), or, for a "
        "run, a sampler without groups (epoch, random)",
    )


def smaller_mean_first(sides: NDArray[np.int64], distances: NDArray[np.float64]) -> int:
    """Return the side, 0 or 1, with the smaller mean distance; 0 if a side is empty.

    Args:
        sides: [V] side of each view: 0 or 1.
        distances: [V] distance of each view.
    """
    means = [float(distances[sides == side].mean()) for side in (0, 1) if (sides == side).any()]
    return int(np.argmin(means)) if len(means) == 2 else 0  # noqa: PLR2004 - both sides


def otsu_threshold(values: NDArray[np.float64]) -> float:
    """Return the threshold of values [N >= 1] with the least variance within its two sides.

    The result is exact, because every threshold between two different sorted values is tried. If
    all values are equal, the result is this value.

    Source: Otsu 1979 (largest variance between classes).
    """
    ordered = np.sort(values)
    return _cut(ordered, _between(ordered))


def otsu_separability(samples: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return [...] the share of the variance that is between the two classes of Otsu's threshold.

    The variance is computed over the last axis of `samples` [..., N >= 2]. The share is 1 for two
    different values, and about 3/4 for many evenly spread values. The share is 0 if all values are
    equal.

    Source: Otsu 1979 (eta, equation 14).
    """
    ordered = np.sort(samples, axis=-1)
    between = _between(ordered).max(axis=-1) / ordered.shape[-1] ** 2
    whole = ordered.var(axis=-1)
    shares = np.zeros_like(whole)
    np.divide(between, whole, out=shares, where=(whole > 0.0) & (between > 0.0))
    return np.asarray(shares)


def _between(ordered: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return [..., N-1] the variance between the two sides of each cut, times N^2.

    The values [..., N] must be sorted. The result is -1 for a cut between equal values.
    """
    sums, total = np.cumsum(ordered, axis=-1)[..., :-1], ordered.sum(axis=-1, keepdims=True)
    left = np.arange(1, ordered.shape[-1])
    right = ordered.shape[-1] - left
    gap = sums / left - (total - sums) / np.maximum(right, 1)
    return np.where(np.diff(ordered, axis=-1) > 0.0, left * right * gap**2, -1.0)


def gap_threshold(values: NDArray[np.float64]) -> float:
    """Return the middle of the widest gap between sorted values [N >= 1]."""
    ordered = np.sort(values)
    return _cut(ordered, np.where(np.diff(ordered) > 0.0, np.diff(ordered), -1.0))


def _cut(ordered: NDArray[np.float64], scores: NDArray[np.float64]) -> float:
    """Return the middle of the gap [N-1] with the best score, between sorted values [N].

    If no score is above 0, the largest value is returned.
    """
    if len(scores) == 0 or scores.max() <= 0.0:
        return float(ordered[-1])
    gap = int(scores.argmax())
    return float((ordered[gap] + ordered[gap + 1]) / 2.0)

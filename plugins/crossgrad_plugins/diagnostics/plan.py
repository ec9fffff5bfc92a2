"""The views of a gradient measurement: equally many near and far views, always the same."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.commands import build
from crossgrad_core.plugin import Grouping, Json, Scene, UserError, footprint_of, radial_distances
from crossgrad_plugins.diagnostics.grouped import SMALLEST_GROUP

#: The default grouping of a gradient measurement, as in the paper.
DEFAULT_GROUPING = "radial"
#: The name that stands for the grouping that a run was trained with.
OF_THE_RUN = "of the run"


@dataclass(frozen=True, eq=False)
class ProbePlan:
    """The views whose gradients are measured.

    Attributes:
        grouping: Name of the grouping, or a text about the origin of the labels.
        near_label: Label of the near group.
        far_label: Label of the far group.
        labels: Label of every training view.
        views: Indices in `scene.train_views`, in ascending order.
        notes: Notes that the grouping returned.
    """

    grouping: str
    near_label: str
    far_label: str
    labels: tuple[str, ...]
    views: tuple[int, ...]
    notes: tuple[str, ...] = ()

    def near(self, views: Sequence[int]) -> NDArray[np.bool_]:
        """Return [V] bool, True for near views."""
        return np.array([self.labels[view] == self.near_label for view in views])

    @property
    def cameras(self) -> tuple[int, int]:
        """Number of (near, far) training views."""
        return self.labels.count(self.near_label), self.labels.count(self.far_label)


def require_views(scene: Scene) -> None:
    """Refuse a scene that has too few views for two groups.

    Raises:
        UserError: The scene has too few training photos.
    """
    least = 2 * SMALLEST_GROUP
    if len(scene.train) < least:
        raise UserError(
            "the scene has too few training photos for a probe",
            where=scene.name,
            expected=f"at least {least}: two groups of {SMALLEST_GROUP}",
            found=str(len(scene.train)),
            todo="use more photos of the scene, or diagnose another scene",
        )


def labelled(
    scene: Scene, grouping: str, seed: int, options: Mapping[str, Json] | None = None
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Label the training views by a grouping with its options; return labels and notes.

    Raises:
        UserError: The grouping does not exist, or it cannot divide this scene.
    """
    component = build(Grouping, grouping, options or {})
    rule = component.fit(scene, np.random.default_rng(seed))
    return rule.labels(scene.train_views), rule.notes


def plan_probe(
    scene: Scene, grouping: str, labels: tuple[str, ...], per_group: int, seed: int
) -> ProbePlan:
    """Draw up to `per_group` views from the nearest group and from the farthest group.

    Args:
        scene: The scene.
        grouping: Name of the grouping.
        labels: Label of every training view. If there are three or more groups, only the nearest
            and the farthest are used.
        per_group: Maximum number of views per group.
        seed: Seed of the generator that draws the views.

    Raises:
        UserError: There is only one group, or a group has only one view.
    """
    near_label, far_label = _outermost(scene, labels)
    rng = np.random.default_rng(seed)
    views: list[int] = []
    for label in (near_label, far_label):
        members = [i for i, view_label in enumerate(labels) if view_label == label]
        if len(members) < SMALLEST_GROUP:
            raise UserError(
                "a probe needs at least two training views in each group",
                where=f"grouping {grouping}",
                found=f"{len(members)} in group {label}",
                todo="choose another grouping",
            )
        count = min(per_group, len(members))
        views += [members[i] for i in rng.choice(len(members), size=count, replace=False)]
    return ProbePlan(grouping, near_label, far_label, labels, tuple(sorted(views)))


def _outermost(scene: Scene, labels: tuple[str, ...]) -> tuple[str, str]:
    """Return the labels of the nearest and of the farthest group."""
    names = sorted(set(labels))
    if len(names) == 1:
        raise UserError(
            "a probe compares two groups of views, but the grouping made only one",
            where="grouping",
            found=f"one group, {names[0]}",
            todo="choose another grouping",
        )
    if {"near", "far"} <= set(names):
        return "near", "far"
    closeness = _closeness(scene)
    mean = {
        name: float(
            np.median([c for c, label in zip(closeness, labels, strict=True) if label == name])
        )
        for name in names
    }
    return max(names, key=lambda name: mean[name]), min(names, key=lambda name: mean[name])


def _closeness(scene: Scene) -> NDArray[np.float64]:
    """Return [N] a number per training view that is larger for nearer views."""
    footprints = np.array([footprint_of(scene, view) for view in scene.train_views])
    if np.isnan(footprints).any():
        return -radial_distances(scene, scene.train_views)
    return footprints

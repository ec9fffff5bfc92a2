"""Contract checks for groupings."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.contract.scene import Scene
from crossgrad_core.contract.slots.grouping import GradientProbe, Grouping, GroupingRule
from crossgrad_core.testing.fixtures import sample_scene
from crossgrad_core.testing.support.components import COMPONENT_CHECKS
from crossgrad_core.testing.support.contract import (
    Check,
    Make,
    cannot_tell,
    global_randomness_untouched,
    require,
)
from crossgrad_core.wording import listed


@dataclass(frozen=True)
class SampleProbe:
    """Artificial gradients of views. Gradients agree within a regime and conflict between regimes.

    Attributes:
        scene: The scene whose views have the regimes.
    """

    scene: Scene

    @property
    def blocks(self) -> tuple[str, ...]:
        """The two blocks for which Gramians exist."""
        return ("means", "f_dc")

    def gramians(self, views: Sequence[int]) -> NDArray[np.float64]:
        """Return the Gramians [2, V, V] of V views, for both blocks."""
        names = [self.scene.train_views[view].regime for view in views]
        same = np.array([[one == other for other in names] for one in names])
        gramian = np.where(same, 0.9, -0.5) + 0.1 * np.eye(len(names))
        return np.stack([gramian, 2.0 * gramian])


def fitted(grouping: Grouping, scene: Scene, seed: int = 0) -> GroupingRule:
    """Return the rule that a grouping derives from a scene."""
    probe: GradientProbe | None = SampleProbe(scene) if grouping.needs_probe else None
    return grouping.fit(scene, np.random.default_rng(seed), probe)


def every_view_has_a_declared_label(make: Make[Grouping]) -> None:
    """Each view has one label.

    If `labels` is not empty, `labels` contains the label of each view.
    """
    grouping, scene = make(), sample_scene()
    rule = fitted(grouping, scene)
    require(isinstance(rule, GroupingRule), f"the result is {rule!r}, not a GroupingRule")
    for views in (scene.train_views, scene.views, scene.views[:1]):
        labels = rule.labels(views)
        require(len(labels) == len(views), f"{len(views)} views have {len(labels)} labels")
        foreign = sorted(set(labels) - set(grouping.labels)) if grouping.labels else []
        require(not foreign, f"labels that are not declared in `labels`: {listed(foreign)}")


def every_group_has_training_views(make: Make[Grouping]) -> None:
    """If a declared group contains no training views, the grouping raises an error.

    A sampler could not draw from this group.
    """
    grouping, scene = make(), sample_scene()
    present = set(fitted(grouping, scene).labels(scene.train_views))
    empty = sorted(set(grouping.labels) - present)
    require(not empty, f"groups without training views: {listed(empty)}; raise UserError instead")


def the_rule_is_fitted_on_training_views(make: Make[Grouping]) -> None:
    """The label of a view depends only on the training views and on the view itself."""
    grouping, scene = make(), sample_scene()
    rule = fitted(grouping, scene)
    together = rule.labels(scene.views)
    for view, label in zip(scene.views, together, strict=True):
        alone = rule.label(view)
        require(
            alone == label,
            f"{view.name} has the label {alone!r} when labelled alone and {label!r} "
            "together with other views",
        )


def the_quantity_is_one_number_per_view(make: Make[Grouping]) -> None:
    """The quantity that is split has a name and one number per view.

    The number does not depend on other views.
    """
    grouping, scene = make(), sample_scene()
    together = grouping.quantity(scene, scene.views)
    if together is None:
        raise cannot_tell("the rule does not split by a single number")
    require(bool(together.name.strip()), "the quantity has no name")
    shape = np.shape(together.values)
    require(shape == (len(scene.views),), f"{len(scene.views)} views have values {list(shape)}")
    for row, view in enumerate(scene.views):
        alone = grouping.quantity(scene, (view,))
        same = alone is not None and np.allclose(alone.values[0], together.values[row])
        require(same, f"{view.name} has another value when it is measured alone")


def same_seed_same_labels(make: Make[Grouping]) -> None:
    """Labels depend only on the arguments, and random numbers come from `rng`."""
    scene = sample_scene()
    with global_randomness_untouched():
        one = fitted(make(), scene).labels(scene.views)
        other = fitted(make(), scene).labels(scene.views)
    require(one == other, "two calls with the same seed return different labels")


GROUPING_CHECKS: tuple[Check[Grouping], ...] = (
    *COMPONENT_CHECKS,
    every_view_has_a_declared_label,
    every_group_has_training_views,
    the_rule_is_fitted_on_training_views,
    the_quantity_is_one_number_per_view,
    same_seed_same_labels,
)

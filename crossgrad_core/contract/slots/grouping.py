"""The grouping slot: a component labels the views for sampling."""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from crossgrad_core.contract.component import Component
from crossgrad_core.contract.contexts import Model
from crossgrad_core.contract.scene import Scene, View


@dataclass(frozen=True, eq=False)
class GroupingRule:
    """The rule that results when a grouping is fitted to the training cameras of a scene.

    Attributes:
        labels: Function from views of the scene to their labels, one per view, in the same order.
        notes: Messages for the user about the fitted rule (its threshold, a fall-back ...).
    """

    labels: Callable[[Sequence[View]], tuple[str, ...]]
    notes: tuple[str, ...] = ()

    def label(self, view: View) -> str:
        """Return the label of one view."""
        return self.labels((view,))[0]


@dataclass(frozen=True, eq=False)
class Quantity:
    """The single number per view by which a grouping splits the views.

    Attributes:
        name: Description of the quantity, such as "the log distance from the mean camera".
        values: [V] float64 in the order of the given views; NaN or infinity if the quantity is
            undefined for a view.
    """

    name: str
    values: NDArray[np.float64]


class GradientProbe(Protocol):
    """Dot products of the gradients of a model with frozen parameters."""

    @property
    def blocks(self) -> tuple[str, ...]:
        """[B] name of each Gramian's block."""
        ...

    def gramians(self, views: Sequence[int]) -> NDArray[np.float64]:
        """Return [B, V, V] float64 Gramians of the gradients of these V training views."""
        ...


class Grouping(Component):
    """A method that labels views: a rule fitted to the training cameras and applied to all views.

    Attributes:
        labels: Every label that the rule can give, near first; empty if the user's input defines
            the labels.
        needs_probe: True if the rule needs gradients and therefore requires a `GradientProbe`.
    """

    slot: ClassVar[str] = "groupings"
    labels: ClassVar[tuple[str, ...]] = ("near", "far")
    needs_probe: ClassVar[bool] = False

    @abstractmethod
    def fit(
        self, scene: Scene, rng: np.random.Generator, probe: GradientProbe | None = None
    ) -> GroupingRule:
        """Return the rule, fitted to `scene.train_views`.

        Args:
            scene: The scene.
            rng: The only source of random numbers.
            probe: Gradients of the training views, for rules that need them.

        Raises:
            UserError: The rule leaves a group without training views; the message suggests a
                remedy.
        """

    def quantity(self, scene: Scene, views: Sequence[View]) -> Quantity | None:
        """Return the quantity by which the rule splits the views.

        Args:
            scene: The scene.
            views: The views whose quantity is returned.

        A run reports if the distribution of the quantity has a single mode. Returns: None (the
        default) for rules that use more than one number per view.
        """
        return None


class Regrouping(Grouping):
    """A grouping that is fitted again after some training."""

    @property
    @abstractmethod
    def refit_after(self) -> int:
        """The step after which the training views are grouped again."""

    @abstractmethod
    def refit(self, model: Model, rng: np.random.Generator) -> GroupingRule:
        """Return the grouping rule for the remaining steps of the run.

        Args:
            model: The model after step `refit_after`, which must not be changed.
            rng: The only source of random numbers.
        """

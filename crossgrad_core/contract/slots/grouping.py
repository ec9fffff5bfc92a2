"""The grouping slot: labels of views, for sampling."""

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
    """A grouping as fitted to the training cameras of a scene.

    Attributes:
        labels: One label per view, for any views of the scene, in their order.
        notes: What the user should know about the rule as fitted (its threshold, a fall-back ...).
    """

    labels: Callable[[Sequence[View]], tuple[str, ...]]
    notes: tuple[str, ...] = ()

    def label(self, view: View) -> str:
        """The label of one view."""
        return self.labels((view,))[0]


@dataclass(frozen=True, eq=False)
class Quantity:
    """The one number per view that a grouping splits.

    Attributes:
        name: What it is, as in "the log distance from the mean camera".
        values: [V] float64 in the order in which the views were given; not finite where a view has
            none.
    """

    name: str
    values: NDArray[np.float64]


class GradientProbe(Protocol):
    """Gradients of a model with frozen parameters, seen through their dot products only."""

    @property
    def blocks(self) -> tuple[str, ...]:
        """[B] name of each Gramian's block."""
        ...

    def gramians(self, views: Sequence[int]) -> NDArray[np.float64]:
        """[B, V, V] float64 Gramians of the gradients of V training views, given by position."""
        ...


class Grouping(Component):
    """Labels views; the rule is fitted on the training cameras and then applied to all.

    Attributes:
        labels: Every label the rule can give, near first; empty where the user's input names them.
        needs_probe: Whether the rule looks at gradients; it then refuses to label without a probe.
    """

    slot: ClassVar[str] = "groupings"
    labels: ClassVar[tuple[str, ...]] = ("near", "far")
    needs_probe: ClassVar[bool] = False

    @abstractmethod
    def fit(
        self, scene: Scene, rng: np.random.Generator, probe: GradientProbe | None = None
    ) -> GroupingRule:
        """The rule, fitted on `scene.train_views`.

        Args:
            scene: The scene.
            rng: The only source of random numbers.
            probe: Gradients of the training views, for rules that need them.

        Raises:
            UserError: The rule leaves a group without training views, with what to do.
        """

    def quantity(self, scene: Scene, views: Sequence[View]) -> Quantity | None:
        """What the rule splits, so that a run can say where that has one mode only.

        Args:
            scene: The scene.
            views: The views to be measured.

        Returns:
            None (the default) for rules that look at more than one number per view.
        """
        return None


class Regrouping(Grouping):
    """A grouping that is fitted anew once the model has learnt something."""

    @property
    @abstractmethod
    def refit_after(self) -> int:
        """The step after which the training views are grouped anew."""

    @abstractmethod
    def refit(self, model: Model, rng: np.random.Generator) -> GroupingRule:
        """The rule for the rest of the run.

        Args:
            model: The model after step `refit_after`; nothing in it may be changed.
            rng: The only source of random numbers.
        """

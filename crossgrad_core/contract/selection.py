"""The chosen components of a run."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

from crossgrad_core.contract.component import Component
from crossgrad_core.contract.schedule import ViewsPerStepSpec
from crossgrad_core.contract.slots.backbone import Backbone
from crossgrad_core.contract.slots.densifier import Densifier
from crossgrad_core.contract.slots.exporter import Exporter
from crossgrad_core.contract.slots.exposure import Exposure
from crossgrad_core.contract.slots.grouping import Grouping
from crossgrad_core.contract.slots.initializer import Initializer
from crossgrad_core.contract.slots.loss import Loss
from crossgrad_core.contract.slots.metric import Metric
from crossgrad_core.contract.slots.operator import Operator
from crossgrad_core.contract.slots.rasterizer import Rasterizer
from crossgrad_core.contract.slots.resolution import Resolution
from crossgrad_core.contract.slots.rule import Rule
from crossgrad_core.contract.slots.sampler import Sampler


@dataclass(frozen=True)
class Selection:
    """The chosen components of a run and further choices that affect whether they work together.

    Attributes:
        backbone: The backbone.
        sampler: The sampler.
        operator: The operator.
        densifier: The densifier.
        rasterizer: The rasterizer.
        loss: The photometric loss.
        exposure: The exposure, which models the brightness and colour response of a camera.
        initializer: The initializer, which adds points to the scene at the start.
        resolution: The resolution, which chooses the scale of each view of a step.
        exporter: The exporter, which writes the trained scene to a file.
        metrics: The metrics of held-out views, by name.
        rules: The rules that act during training, by name.
        names: Slot (singular word, `reader` included) -> name under which the component was chosen.
        views_per_step: Number of views per step, K; the largest number if K changes.
        device: Torch device type.
        grouping: The grouping; None if the run has no grouping.
        labels: Labels that the grouping gives to training views; None if the labels are not known
            yet or the run has no grouping.
        view_plan: Values of K over the run; None if K is always `views_per_step`.
    """

    backbone: Backbone
    sampler: Sampler
    operator: Operator
    densifier: Densifier
    rasterizer: Rasterizer
    loss: Loss
    exposure: Exposure
    initializer: Initializer
    resolution: Resolution
    exporter: Exporter
    metrics: Mapping[str, Metric]
    names: Mapping[str, str]
    views_per_step: int
    device: str
    grouping: Grouping | None = None
    labels: tuple[str, ...] | None = None
    view_plan: ViewsPerStepSpec | None = None
    rules: Mapping[str, Rule] = field(default_factory=dict)

    @property
    def views(self) -> ViewsPerStepSpec:
        """The number of views K of every step of the run."""
        return self.view_plan or ViewsPerStepSpec((self.views_per_step,))

    @property
    def components(self) -> dict[str, Component]:
        """Slot (singular word) -> component, for the slots that have a component."""
        filled: dict[str, Component | None] = {
            "backbone": self.backbone,
            "sampler": self.sampler,
            "operator": self.operator,
            "densifier": self.densifier,
            "rasterizer": self.rasterizer,
            "loss": self.loss,
            "exposure": self.exposure,
            "initializer": self.initializer,
            "resolution": self.resolution,
            "exporter": self.exporter,
            "grouping": self.grouping,
        }
        return {slot: component for slot, component in filled.items() if component is not None}

    @property
    def plugins(self) -> dict[str, object]:
        """Name -> plugin, for the components and the rules."""
        return {**self.components, **{f"rule:{name}": rule for name, rule in self.rules.items()}}


@runtime_checkable
class HasUnusedOptions(Protocol):
    """A component that reports which of its options would change nothing."""

    def unused_options(self, selection: Selection) -> Mapping[str, str]:
        """Return options that would change nothing in this selection: name -> reason and remedy.

        A new run is refused if the user set one of these options to a value other than its default.
        """
        ...

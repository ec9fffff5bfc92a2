"""The rule slot: plugins that change the training in addition to the basic training loop."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from crossgrad_core.contract.component import Component
from crossgrad_core.contract.contexts import Answer, DensifyResult, StepContext
from crossgrad_core.contract.gaussians import Gaussians
from crossgrad_core.contract.scene import Scene, View
from crossgrad_core.contract.slots.backbone import Backbone


class Rule(Component):
    """A plugin that changes the training through hooks (`@hookimpl`), if a run selects it.

    The rule's installed name is also the name of its state and of its random generator.

    Attributes:
        copies: Maximum number of copies of the parameters that the rule's state contains. Copies in
            the state of the previous step and in the rollback state count as well. Density control
            leaves memory for these copies.
    """

    slot: ClassVar[str] = "rules"
    copies: ClassVar[int] = 0

    def unused(self, backbone: Backbone, scene: Scene) -> str:
        """Return why the rule would change nothing in this run; empty if it would change something.

        A new run is refused if the user selects a rule that would change nothing.
        """
        return ""


@dataclass(frozen=True, eq=False)
class GaussiansContext(StepContext):
    """The context of `crossgrad_view_gaussians`.

    Attributes:
        view: The training view that is rendered.
        gaussians: The Gaussians that the backbone decoded for the view, with their autograd graph
            and with the changes of earlier rules.
        rngs: Name of a rule -> its generator, the only source of its random numbers.
    """

    view: View
    gaussians: Gaussians
    rngs: Mapping[str, np.random.Generator]


@dataclass(frozen=True, eq=False)
class GaussiansResult(Answer):
    """Result of `crossgrad_view_gaussians`: the Gaussians to render, as many as before."""

    gaussians: Gaussians


@dataclass(frozen=True, eq=False)
class FinalEdit(DensifyResult):
    """Result of `crossgrad_final_edit`: the edit of a finished run, and a line for the log."""

    note: str

"""The rule slot: acts during training, and is not part of the basic loop."""

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

    Its state goes by the name under which it is installed, and so does its random generator.

    Attributes:
        copies: Copies of the parameters that its state holds at most, including those of the step
            before and of the state to go back to; growth leaves memory for them.
    """

    slot: ClassVar[str] = "rules"
    copies: ClassVar[int] = 0

    def unused(self, backbone: Backbone, scene: Scene) -> str:
        """Return why the rule would change nothing in this run; empty if it would change something.

        A new run is refused if the user asks for a rule that would change nothing.
        """
        return ""


@dataclass(frozen=True, eq=False)
class GaussiansContext(StepContext):
    """For `crossgrad_view_gaussians`.

    Attributes:
        view: The training view that is rendered.
        gaussians: The Gaussians that the backbone decoded for it, with their graph; if another rule
            has changed them already, the changed ones.
        rngs: Name of a rule -> its generator, from which all of its random numbers must come.
    """

    view: View
    gaussians: Gaussians
    rngs: Mapping[str, np.random.Generator]


@dataclass(frozen=True, eq=False)
class GaussiansResult(Answer):
    """Answer of `crossgrad_view_gaussians`: the Gaussians that are rendered, as many as before."""

    gaussians: Gaussians


@dataclass(frozen=True, eq=False)
class FinalEdit(DensifyResult):
    """Answer of `crossgrad_final_edit`: the edit of a finished run, and a line for its log."""

    note: str

"""The resolution slot: at which scale the views of a step are rendered and compared."""

from abc import abstractmethod
from typing import ClassVar

from crossgrad_core.contract.component import Component
from crossgrad_core.contract.contexts import ScaleContext, Scaled
from crossgrad_core.contract.marks import hookimpl
from crossgrad_core.contract.state import PluginState

STATE = "resolution"


class Resolution(Component):
    """Chooses, for the views that the sampler drew, the scale of each.

    A view of scale s is rendered with its camera in s times its size, and compared with its photo
    reduced to that size by area. Evaluation is always at full size. Screen statistics reach density
    control in units of the full photo.
    """

    slot: ClassVar[str] = "resolutions"

    @abstractmethod
    def scales(
        self, context: ScaleContext, state: PluginState
    ) -> tuple[tuple[float, ...], PluginState]:
        """One scale in (0, 1] for each view of `context.draw`, and the new state.

        Random numbers come from `context.rng`.
        """

    @hookimpl
    def crossgrad_choose_scales(self, context: ScaleContext) -> Scaled:
        """Answers with this resolution's scales."""
        scales, state = self.scales(context, context.state(STATE))
        return Scaled(scales, states={STATE: state})

"""The resolution slot: at which scale the views of a step are rendered and compared."""

from abc import abstractmethod
from collections.abc import Sequence
from math import log2
from typing import ClassVar

from crossgrad_core.contract.blocks import PluginState
from crossgrad_core.contract.component import Component, hookimpl, with_state
from crossgrad_core.contract.contexts import ScaleContext, ScaleResult
from crossgrad_core.contract.scene import Scene
from crossgrad_core.contract.schedule import Schedule

STATE = "resolution"


def octave(scale: float) -> int:
    """The power of two nearest to a scale: 0 at full size, -1 at half of it.

    Reducing a photo takes detail away, and the loss falls with it. Losses of one octave compare;
    a running loss begins anew where the octave changes.
    """
    return round(log2(scale))


class Resolution(Component):
    """Chooses, for the views that the sampler drew, the scale of each.

    A view of scale s is rendered with its camera in s times its size, and compared with its photo
    reduced to that size by area. Evaluation is always at full size. Screen statistics reach density
    control in units of the full photo.

    Attributes:
        strided: Whether a view of scale 1 / n is rendered at one pixel of each n x n instead, in
            each step another one, and compared with these pixels of its photo.
    """

    slot: ClassVar[str] = "resolutions"
    strided: ClassVar[bool] = False

    def fitted_to(self, scene: Scene) -> "Resolution":
        """This resolution with what it measures of the scene; by default as it is.

        It is written to config.yaml, so that a run which goes on asks that one.
        """
        return self

    def messages(self, schedule: Schedule) -> tuple[str, ...]:
        """What to note about the scales of a run with this schedule; asked anew as it changes."""
        return ()

    def pixels(self, schedule: Schedule, step: int) -> float:
        """Pixels that all steps up to and including this one render, in photos of full size.

        Budgets of seconds plan with them. By default every view has its full size.
        """
        return schedule.pace.views(step)

    @abstractmethod
    def scales(
        self, context: ScaleContext, state: PluginState
    ) -> tuple[tuple[float, ...], PluginState]:
        """One scale in (0, 1] for each view of `context.draw`, and the new state.

        Random numbers come from `context.rng`.
        """

    @hookimpl
    def crossgrad_choose_scales(self, context: ScaleContext) -> ScaleResult:
        """Answers with this resolution's scales."""
        answer = self.scales(context, context.state(STATE))
        scales, state = with_state(answer, Sequence, self, "scales")
        return ScaleResult(tuple(scales), states={STATE: state})

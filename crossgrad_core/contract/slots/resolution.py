"""The resolution slot: a component chooses the scale at which views are rendered and compared."""

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
    """Return the rounded base-2 logarithm of a scale: 0 at full size, -1 at half size.

    A reduced photo contains less detail, so its loss is lower. Only losses of the same octave are
    comparable; a running mean of losses must start again when the octave changes.
    """
    return round(log2(scale))


class Resolution(Component):
    """A rule that chooses the scale of each view that the sampler drew.

    A view of scale s is rendered with its camera resized by s, and compared with its photo reduced
    to this size by an area filter. Evaluation is always at full size. Density control gets screen
    statistics in units of the full photo.

    Attributes:
        strided: True if a view of scale 1 / n is rendered at one pixel of each n x n block of the
            full-size image. The loss compares these pixels with the same pixels of the photo. The
            rendered pixel of a block differs from step to step.
    """

    slot: ClassVar[str] = "resolutions"
    strided: ClassVar[bool] = False

    def fitted_to(self, scene: Scene) -> "Resolution":
        """Return this resolution with values measured from the scene; by default unchanged.

        The result is written to config.yaml, and a resumed run uses the stored values.
        """
        return self

    def messages(self, schedule: Schedule) -> tuple[str, ...]:
        """Return messages about the scales under this schedule; called again for a new schedule."""
        return ()

    def pixels(self, schedule: Schedule, step: int) -> float:
        """Return the number of pixels rendered until the end of a step, in units of one full photo.

        Time budgets use this number for planning. By default all views are rendered at full size.
        """
        return schedule.pace.views(step)

    @abstractmethod
    def scales(
        self, context: ScaleContext, state: PluginState
    ) -> tuple[tuple[float, ...], PluginState]:
        """Return one scale in (0, 1] for each view of `context.draw`, and the new state.

        Random numbers must come from `context.rng`.
        """

    @hookimpl
    def crossgrad_choose_scales(self, context: ScaleContext) -> ScaleResult:
        """Return this resolution's result for the hook."""
        answer = self.scales(context, context.state(STATE))
        scales, state = with_state(answer, Sequence, self, "scales")
        return ScaleResult(tuple(scales), states={STATE: state})

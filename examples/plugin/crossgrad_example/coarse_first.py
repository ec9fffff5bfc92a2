"""A resolution that starts with small photos."""

from typing_extensions import override

from crossgrad_core.plugin import Field, PluginState, Resolution, ScaleContext


class CoarseFirst(Resolution):
    """Renders and compares smaller photos in the first part of the run."""

    scale: float = Field(0.5, gt=0, le=1, description="scale at the start of the run")
    share: float = Field(0.25, ge=0, le=1, description="share of the steps that use this scale")

    @override
    def scales(
        self, context: ScaleContext, state: PluginState
    ) -> tuple[tuple[float, ...], PluginState]:
        first = context.step <= self.share * context.schedule.total
        return (self.scale if first else 1.0,) * len(context.draw.views), state

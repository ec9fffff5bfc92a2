"""At which scale the views of a step are rendered and compared."""

from typing_extensions import override

from crossgrad_core.plugin import Field, PluginState, Resolution, ScaleContext


class Template(Resolution):
    """Every view at one scale."""

    scale: float = Field(0.5, gt=0.0, le=1.0, description="of the photo's size")

    @override
    def scales(
        self, context: ScaleContext, state: PluginState
    ) -> tuple[tuple[float, ...], PluginState]:
        return (self.scale,) * len(context.draw.views), state

"""Every view at full size."""

from typing_extensions import override

from crossgrad_core.plugin import PluginState, Resolution, ScaleContext


class FullSize(Resolution):
    """Renders and compares every view at the size of its training photo."""

    @override
    def scales(
        self, context: ScaleContext, state: PluginState
    ) -> tuple[tuple[float, ...], PluginState]:
        return (1.0,) * len(context.draw.views), state

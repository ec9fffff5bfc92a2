"""Every view in its full size."""

from typing_extensions import override

from crossgrad_core.plugin import PluginState, Resolution, ScaleContext


class FullSize(Resolution):
    """Renders and compares every view in the size of its photo as trained."""

    @override
    def scales(
        self, context: ScaleContext, state: PluginState
    ) -> tuple[tuple[float, ...], PluginState]:
        return (1.0,) * len(context.draw.views), state

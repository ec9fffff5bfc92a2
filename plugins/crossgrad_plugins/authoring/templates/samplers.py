"""Which views a step renders."""

from typing import ClassVar

from typing_extensions import override

from crossgrad_core.plugin import PluginState, SampleContext, Sampler, ViewSample


class Template(Sampler):
    """Draws K training views at random."""

    default_views: ClassVar[int] = 2
    reads_groups: ClassVar[bool] = False

    @override
    def sample(self, context: SampleContext, state: PluginState) -> tuple[ViewSample, PluginState]:
        views = context.rng.integers(len(context.scene.train), size=context.views_per_step)
        labels = None if context.groups is None else tuple(context.groups[view] for view in views)
        return ViewSample(tuple(int(view) for view in views), labels), state

"""A sampler that draws the least often rendered views first."""

from typing import ClassVar, cast

import numpy as np
from typing_extensions import override

from crossgrad_core.plugin import PluginState, SampleContext, Sampler, ViewSample


class LeastSeen(Sampler):
    """Draws the K training views that were rendered least often; ties are broken at random."""

    default_views: ClassVar[int] = 2

    @override
    def sample(self, context: SampleContext, state: PluginState) -> tuple[ViewSample, PluginState]:
        number = len(context.scene.train)
        seen = np.array(cast("list[int]", state.values.get("seen", [0] * number)))
        order = np.lexsort((context.rng.random(number), seen))
        views = tuple(int(view) for view in order[: context.views_per_step])
        seen[list(views)] += 1
        groups = context.groups
        labels = None if groups is None else tuple(groups[view] for view in views)
        return ViewSample(views, labels), PluginState({"seen": seen.tolist()})

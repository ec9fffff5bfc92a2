"""Active pairs: a view, and a partner from the other group whose loss is very different."""

from collections.abc import Mapping, Sequence
from math import isfinite
from typing import ClassVar, cast

import numpy as np
from pydantic import Field
from typing_extensions import override

from crossgrad_core.plugin import (
    Json,
    PluginState,
    SampleContext,
    Sampler,
    StepRecord,
    ViewCounts,
    ViewSample,
    octave,
)
from crossgrad_plugins.samplers.draws import drawn, groups_of, training_views

_SMALLEST_TEMPERATURE = 1e-8


class Active(Sampler):
    """Draws a uniform view, and a partner of the other group by the difference of their losses.

    The partner is one of the `top` views of the other group with the largest |loss - loss of the
    first view|. It is drawn with softmax probabilities; their temperature is the standard deviation
    of these loss differences. Every view has a running mean of its losses. This mean starts again
    when the view's resolution changes to another octave. Views that were never rendered have no
    running mean and are drawn first, as first view or as partner.

    Source: the paper, active loss-disparity pairing. The values of top, temperature and decay were
    chosen for crossgrad, because the paper does not give them.
    """

    views: ClassVar[ViewCounts] = ViewCounts(2, 2)
    default_views: ClassVar[int] = 2
    default_grouping: ClassVar[str | None] = "radial"
    groups: ClassVar[int | None] = 2

    top: int = Field(
        8, ge=1, description="number of candidate partners; all views of a smaller group"
    )
    decay: float = Field(0.9, ge=0.0, lt=1.0, description="decay of a view's running loss")

    @override
    def sample(self, context: SampleContext, state: PluginState) -> tuple[ViewSample, PluginState]:
        losses, octaves = self._running_losses(context.last, state)
        groups = groups_of(context, "active", 2)
        views = training_views(context)
        first = _uniform(_never_rendered(views, losses) or views, context.rng)
        others = next(pool for pool in groups.values() if first not in pool)
        second = self._partner(first, others, losses, context.rng)
        values: dict[str, Json] = {"losses": cast("dict[str, Json]", losses)}
        if octaves:
            values["octaves"] = cast("dict[str, Json]", octaves)
        return drawn((first, second), context), PluginState(values)

    def _running_losses(
        self, last: StepRecord | None, state: PluginState
    ) -> tuple[dict[str, float], dict[str, int]]:
        """Return the running mean of the loss and the octave of each view.

        Keys are view indices as text, for JSON. The means include the last completed step. The mean
        of a view starts again when the view is rendered at another octave of resolution. Views at
        full size have no octave entry.
        """
        losses = dict(cast("Mapping[str, float]", state.values.get("losses", {})))
        octaves = dict(cast("Mapping[str, int]", state.values.get("octaves", {})))
        if last is None:
            return losses, octaves
        scales = last.scales or (1.0,) * len(last.views)
        for index, loss, scale in zip(last.views, last.losses, scales, strict=True):
            if not isfinite(loss):
                continue
            view, level = str(index), octave(scale)
            old = losses.get(view, loss) if octaves.pop(view, 0) == level else loss
            losses[view] = self.decay * old + (1.0 - self.decay) * loss
            if level:
                octaves[view] = level
        return losses, octaves

    def _partner(
        self,
        first: int,
        others: Sequence[int],
        losses: Mapping[str, float],
        rng: np.random.Generator,
    ) -> int:
        """Return the partner of the first view.

        A view of the other group that was never rendered is preferred. Without such a view, the
        partner is drawn by the difference of losses.
        """
        fresh = _never_rendered(others, losses)
        if fresh or str(first) not in losses:
            return _uniform(fresh or others, rng)
        scores = np.abs(np.array([losses[str(view)] for view in others]) - losses[str(first)])
        # Use a stable sort, so that views with equal differences keep their order.
        best = np.argsort(-scores, kind="stable")[: self.top]
        temperature = max(float(scores[best].std()), _SMALLEST_TEMPERATURE)
        logits = (scores[best] - scores[best].max()) / temperature
        weights = np.exp(logits)
        return others[int(rng.choice(best, p=weights / weights.sum()))]


def _never_rendered(pool: Sequence[int], losses: Mapping[str, float]) -> list[int]:
    """Return the views of the pool that have no running mean of the loss."""
    return [view for view in pool if str(view) not in losses]


def _uniform(pool: Sequence[int], rng: np.random.Generator) -> int:
    return int(pool[int(rng.integers(len(pool)))])
